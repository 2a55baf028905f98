"""Learning-rate and loss-weight schedules: pure functions of x, the run's fraction in [0, 1].

Outside its range a schedule keeps its nearest end value. All return Python floats, because a NumPy scalar
would end up in optimizer state and checkpoints, where a safe loader rejects it.
"""

from __future__ import annotations

import math


def log_linear(x: float, start: float, end: float) -> float:
    """Interpolate from start to end (both positive), linearly in the logarithm."""
    x = _fraction(x)
    return math.exp((1 - x) * math.log(start) + x * math.log(end))


def semantic_ramp(x: float, share: float) -> float:
    """Raise the weight of the semantic losses from 0.1 to 1 over the run's first `share`: geometry leads."""
    return log_linear(x / share if share > 0 else 1.0, 0.1, 1.0)


def cosine_decay(x: float, peak: float, end: float, power: float = 1.0) -> float:
    """Go from peak to end along half a cosine of x^power; a power above 1 stays near the peak longer."""
    peak, end = float(peak), float(end)
    return end + 0.5 * (peak - end) * (1 + math.cos(math.pi * _fraction(x) ** float(power)))


def _fraction(x: float) -> float:
    return min(max(float(x), 0.0), 1.0)
