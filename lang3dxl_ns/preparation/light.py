"""Correction of dark photos to the brightness and tint of the photos that a small encoder was trained on."""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

_DIM = 0.75
"""Share of the known brightness below which a photo is dark; nearly all photos of landmarks are above it."""
_DARKEST = 0.02
"""Lower bound on a photo's mean brightness, so that black photos stay black and exponents stay moderate."""


def in_known_light(photo: Float[Tensor, "h w 3"], brightness: float) -> Float[Tensor, "h w 3"]:
    """Bring a dark photo (RGB in 0…1) to about this mean, the same in all channels; others stay unchanged.

    A gamma curve sets the brightness, which keeps black and white. Then each channel is multiplied (gray
    world), which removes a tint. Encoders trained on millions of photos need neither.
    """
    mean = max(float(photo.mean()), _DARKEST)
    if mean >= _DIM * brightness:
        return photo
    lit = photo ** (math.log(brightness) / math.log(mean))
    channels = lit.mean((0, 1))
    return (lit * (channels.mean() / channels.clamp_min(_DARKEST))).clamp(0, 1)
