"""Learning rates and other schedules, of runs of any length; the paper's too.

A schedule is a function of x, the run's fraction, and keeps its nearest end value outside [0, 1]. All return
Python floats, because a safe loader rejects NumPy scalars in checkpoints.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeVar

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from lang3dxl_ns.training.scene_settings import EXTENT

SHORT_RUN = 1_000
"""Iterations up to which runs use the short-run rates."""
LONG_RUN = 30_000
"""Iterations from which runs use the published rates."""


def run_length_weight(iterations: int) -> float:
    """Compute the position of a run between the short (0) and the long one (1), on a logarithmic scale."""
    position = math.log(max(iterations, 1) / SHORT_RUN) / math.log(LONG_RUN / SHORT_RUN)
    return _fraction(position)


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


Fitted = TypeVar("Fitted", bound="Rate")


@dataclass
class Rate:
    """Settings of Adam with a learning rate for the length of the run."""

    lr: float = 5e-4
    """Learning rate, for runs of 30,000 iterations and more."""
    eps: float = 1e-15
    """Constant in Adam's denominator, as in 3D Gaussian splatting: early gradients of codes are tiny."""
    weight_decay: float = 0.0
    """Weight of the squared parameters in the loss."""
    short_lr: float | None = None
    """Rate for runs of up to 1,000 iterations, where `lr` is for 30,000 and more; in between, the two are
    interpolated on a logarithmic scale. None: the same as `lr`."""

    def fitted(self: Fitted, iterations: int) -> Fitted:
        """Return these settings with `lr` for a run of this many iterations."""
        if self.short_lr is None:
            return self
        rate = log_linear(run_length_weight(iterations), self.short_lr, self.lr)
        return replace(self, lr=rate, short_lr=None)

    def adam(self, parameters: Iterable[Tensor]) -> Adam:
        """Build Adam for these parameters."""
        parameters = list(parameters)
        # The fused form takes one pass over parameters and moments. A CPU otherwise takes ten, which for the
        # tables of hash grids costs more than rendering.
        fused = True if all(p.device.type == "cpu" for p in parameters) else None
        return Adam(parameters, lr=self.lr, eps=self.eps, weight_decay=self.weight_decay, fused=fused)


@dataclass
class Schedule:
    """Learning-rate curve in fractions of the run: warm-up (log-linear), then decay."""

    start: float = 1.0
    """Multiple of the rate at the first iteration."""
    warm: float = 0.0
    """Fraction of the run until the full rate."""
    end: float = 1.0
    """Multiple of the rate at the end."""
    shape: Literal["cosine", "log-linear"] = "cosine"
    """Shape of the decay after the warm-up."""
    power: float = 1.0
    """Power to which the fraction is first raised, for `cosine` only; 2 keeps the rate high longer."""
    until: float = 1.0
    """Fraction of the run at which the end is reached; the rate is constant afterwards."""
    total_steps: int = LONG_RUN
    """Iterations of the run. The trainer sets it."""

    def multiple(self, step: int) -> float:
        """Compute the multiple of the rate at an iteration."""
        x = min(step / max(self.total_steps, 1) / self.until, 1.0)
        if x < self.warm:
            return log_linear(x / self.warm, self.start, 1.0)
        rest = (x - self.warm) / (1.0 - self.warm) if self.warm < 1.0 else 1.0
        if self.shape == "log-linear":
            return log_linear(rest, 1.0, self.end)
        return cosine_decay(rest, 1.0, self.end, self.power)

    def scheduler(self, optimizer: Optimizer) -> LambdaLR:
        """Build torch's scheduler for an optimizer."""
        # A plain function is used, since LambdaLR would put a callable object's state into the checkpoint.
        return LambdaLR(optimizer, lambda step: self.multiple(step))


Rates = Mapping[str, tuple[Rate, Schedule | None]]
"""Rate and schedule of each parameter group."""


def learning_rates() -> dict[str, tuple[Rate, Schedule | None]]:
    """Return the rates of every parameter group, for long and short runs, with schedules in fractions of the
    run."""
    learned = partial(Schedule, start=0.1, warm=0.05, end=0.01, power=2.0)
    return {
        "means": (Rate(lr=1.6e-4, short_lr=6.4e-4), Schedule(shape="log-linear", end=0.01)),
        "features_dc": (Rate(lr=2.5e-3, short_lr=7.5e-3), Schedule(end=0.1, power=2.0)),
        "features_rest": (Rate(lr=2.5e-3 / 20), Schedule(end=0.1, power=2.0)),
        "opacities": (Rate(lr=0.05), None),
        "scales": (Rate(lr=5e-3, short_lr=1.5e-2), None),
        "quats": (Rate(lr=1e-3, short_lr=5e-3), None),
        "sky": (Rate(lr=1e-3, short_lr=5e-3), Schedule(end=0.1)),
        "codes": (Rate(lr=1e-3, short_lr=3e-2), Schedule(end=0.05)),
        "field_encoding": (Rate(lr=5e-4, short_lr=1e-2), learned()),
        "field_decoder": (Rate(lr=5e-4, short_lr=1e-2, weight_decay=1e-5), learned()),
        "downsampler": (Rate(lr=5e-4, short_lr=5e-3, weight_decay=1e-5), learned()),
        "appearance": (Rate(lr=5e-4, short_lr=5e-3), Schedule(start=0.1, warm=0.05, end=0.1)),
        "appearance_vectors": (Rate(lr=1e-3, short_lr=5e-3), Schedule(end=0.1)),
        "camera_opt": (Rate(lr=1e-4), Schedule(shape="log-linear", end=5e-3)),
    }


def printed_learning_rates() -> dict[str, tuple[Rate, Schedule | None]]:
    """Return the paper's rates of every parameter group, with the short-run rates of `learning_rates`."""
    learned = partial(Schedule, start=0.1, warm=0.5, end=0.01, power=2.0)
    rates = learning_rates()
    schedules = {
        "codes": Schedule(end=0.01),
        "appearance": Schedule(start=0.1, warm=0.3, end=0.1),
        **{name: learned() for name in ("field_encoding", "field_decoder", "downsampler")},
    }
    means = Schedule(shape="log-linear", end=0.01, until=30_000 / 70_000)
    return {
        **{name: (rate, schedules.get(name, decay)) for name, (rate, decay) in rates.items()},
        "means": (Rate(lr=1.6e-5 * EXTENT, short_lr=6.4e-4), means),
    }


def add_rows_to_state(optimizer: Optimizer) -> None:
    """Give rows that a resumed run added to a parameter (vectors of new photos) an optimizer state of 0."""
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            if value.dim() and len(value) < len(parameter):
                added = value.new_zeros(len(parameter) - len(value), *value.shape[1:])
                state[name] = torch.cat((value, added))
