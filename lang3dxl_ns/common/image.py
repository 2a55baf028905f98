"""Resizing of images and maps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor


def fitted_size(shape: Sequence[int], longer_side: int) -> tuple[int, int]:
    """Compute rows and columns of a map of at most `longer_side` pixels, from those of a larger one."""
    height, width = shape[:2]
    scale = min(longer_side / max(height, width), 1.0)
    return max(round(height * scale), 1), max(round(width * scale), 1)


def resize_nearest(values: Shaped[Tensor, "H W *c"], size: tuple[int, int]) -> Shaped[Tensor, "h w *c"]:
    """Resize to the values under the pixels' centers, because the mean of two codes or labels is
    meaningless."""
    rows, columns = (
        ((torch.arange(n, device=values.device) + 0.5) * length / n).long()
        for n, length in zip(size, values.shape[:2], strict=True)
    )
    return values[rows[:, None], columns]


def resize(values: Float[Tensor, "h w c"], grid: tuple[int, int]) -> Float[Tensor, "hd wd c"]:
    """Resize bilinearly, with averaging when shrinking."""
    if values.shape[:2] == grid:
        return values
    planes = values.permute(2, 0, 1)[None]
    return F.interpolate(planes, grid, mode="bilinear", antialias=True)[0].permute(1, 2, 0)
