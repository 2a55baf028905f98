"""Stored values of Gaussians: logarithms of scales, logits of opacities, and the memory that they take."""

from __future__ import annotations

from math import isqrt
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.rendering import Splats

ALL_BANDS = 16
"""Number of harmonics up to degree 3. Those of higher degrees are dropped."""
LEAST_OPACITY = 1e-6
"""Smallest distance of stored opacities from 0 and 1, where logits are infinite."""


def check_memory(count: int, bands: int) -> None:
    """Raise UserError if Gaussians with `bands` harmonics don't fit into memory while they are read."""
    needed, there = 3 * 4 * count * (11 + 3 * bands), machine_memory()
    if needed > there:
        raise UserError(
            f"{count:,} Gaussians need {needed / 1e9:.0f} GB of memory, and this machine has "
            f"{there / 1e9:.0f}: prune the splat (SuperSplat does), or use a larger machine"
        )


def activated(
    means: Any, log_scales: Any, quats: Any, logits: Any, harmonics: Any, antialiased: bool = False
) -> Splats:
    """Build splats from stored values [n, …]: logarithms of scales, logits of opacities, and harmonics
    [n, k, 3] of any degree. Raises ValueError if their shapes don't match."""
    means, log_scales, quats, logits, harmonics = map(
        tensor_of, (means, log_scales, quats, logits, harmonics)
    )
    bands = harmonics.shape[1]
    expect(isqrt(bands) ** 2 == bands, f"it has {bands} harmonics per color")
    sides = [part.shape[-1] for part in (means, log_scales, quats, harmonics)]
    expect(sides == [3, 3, 4, 3], f"its parts have {sides} numbers a Gaussian")
    opacities, harmonics = logits.reshape(-1).sigmoid(), harmonics[:, :ALL_BANDS].contiguous()
    return Splats(means, quats, log_scales.exp(), opacities, harmonics, antialiased)


def flat(scales: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """Return the logarithms of the scales of flat Gaussians (2D Gaussian splatting), which have two."""
    return torch.cat([scales, scales.amin(1, keepdim=True) - 5], dim=1)


def logits(splats: Splats) -> Float[Tensor, " n"]:
    """Compute the logits of the opacities."""
    return splats.opacities.clamp(LEAST_OPACITY, 1 - LEAST_OPACITY).logit()


def log_scales(splats: Splats) -> Float[Tensor, "n 3"]:
    """Compute the logarithms of the scales."""
    return splats.scales.clamp_min(1e-30).log()


def tensor_of(values: Any) -> Float[Tensor, "n ..."]:
    """Return an array or a tensor as a tensor of float32, without gradient."""
    tensor = values if isinstance(values, Tensor) else torch.from_numpy(np.ascontiguousarray(values))
    return tensor.detach().float()


def array_of(tensor: Tensor) -> Float32[Array, "..."]:
    """Return a tensor as a NumPy array of float32, without gradient."""
    return tensor.detach().cpu().float().numpy()
