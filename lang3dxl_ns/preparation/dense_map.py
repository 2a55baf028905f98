"""Map of a photo's patch features, from overlapping windows at several sizes, so that small things show."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.common.memory import with_less_memory

RULE = 2
"""Increased when the way maps are made changes, so that older ones are made again."""
Grid = tuple[int, int]
"""Rows and columns of patches."""
EncodePatches = Callable[[Float[Tensor, "n 3 h w"]], Float[Tensor, "n rows columns c"]]
JoinSizes = Callable[[Float[Tensor, "sizes rows columns c"]], Float[Tensor, "rows columns f"]]

_FINER = 1.75
"""Ratio of the fine size to the coarse one: two windows that overlap by a quarter cover 1.75."""
_OVERLAP = 0.25


def map_grids(height: int, width: int, tokens: int, least: int) -> tuple[Grid, Grid]:
    """Compute the grids of a photo's patches at two sizes, coarse and fine, for windows of `tokens` patches
    per side. At the coarse size one window spans the photo's shorter side. The fine grid has 1.75 times as
    many patches along each side, or `least` along the longer one if those are more."""
    shorter = min(height, width)
    finer = max(_FINER, least / (tokens * max(height, width) / shorter))
    coarse, fine = (
        (round(f * tokens * height / shorter), round(f * tokens * width / shorter)) for f in (1.0, finer)
    )
    return coarse, fine


def nested_grids(height: int, width: int, tokens: int, side: int, sizes: int) -> tuple[Grid, ...]:
    """Compute the grids of a photo's patches, coarse to fine, in windows of `side` pixels, twice that, and so
    on, for a number of `sizes`. A window has `tokens` patches per side, and is at most as large as the
    photo."""
    sides = [side * 2**n for n in reversed(range(sizes))]
    return tuple(
        (max(round(tokens * height / s), tokens), max(round(tokens * width / s), tokens)) for s in sides
    )


@torch.no_grad()
def build_dense_map(
    photo: Float[Tensor, "h w 3"],
    grids: Sequence[Grid],
    encode: EncodePatches,
    tokens: int,
    patch_size: int,
    batch_size: int,
    join: JoinSizes | None = None,
) -> Float[Tensor, "rows columns f"]:
    """Build the map: patch features of unit length, blended at each size, joined on the last grid.

    Args:
        photo: RGB in 0…1.
        grids: grid of patches of each size, the finest last (`map_grids`, `nested_grids`).
        encode: encodes windows of `tokens` patches per side, each of `patch_size` pixels (`encode_patches`).
        batch_size: windows encoded at once; fewer if memory runs out.
        join: makes one map of those of all sizes, which are in the order of `grids`; default: their mean.
    """
    maps = []
    for grid in grids:
        one_size = partial(_one_size, photo, grid, encode, tokens, patch_size)
        features = with_less_memory(one_size, batch_size)
        maps.append(F.interpolate(features[None], grids[-1], mode="bilinear", align_corners=False)[0])
    sizes = torch.stack(maps).permute(0, 2, 3, 1)
    return (sizes.mean(0) if join is None else join(sizes)).contiguous()


def _one_size(
    photo: Float[Tensor, "h w 3"],
    grid: Grid,
    encode: EncodePatches,
    tokens: int,
    patch_size: int,
    batch_size: int,
) -> Float[Tensor, "c rows columns"]:
    """Build the map at one size from overlapping windows, whose weight falls towards their edges."""
    pixels = (grid[0] * patch_size, grid[1] * patch_size)
    planes = photo.permute(2, 0, 1)[None]
    image = F.interpolate(planes, pixels, mode="bicubic", antialias=True).clamp(0, 1)[0]
    places = torch.cartesian_prod(*(window_starts(length, tokens) for length in grid))
    side, rising = tokens * patch_size, torch.arange(1.0, tokens + 1)
    slope = torch.minimum(rising, rising.flip(0))
    tent, total, weight = torch.outer(slope, slope), torch.zeros(()), torch.zeros(grid)
    for part in places.split(batch_size):
        corners = (part * patch_size).tolist()
        windows = torch.stack([image[:, y : y + side, x : x + side] for y, x in corners])
        for (row, column), features in zip(part.tolist(), encode(windows), strict=True):
            if not total.dim():
                total = features.new_zeros(*grid, features.shape[-1])
                tent, weight = tent.to(features), weight.to(features)
            place = slice(row, row + tokens), slice(column, column + tokens)
            total[place] += tent[..., None] * F.normalize(features, dim=-1)
            weight[place] += tent
    return (total / weight[..., None]).permute(2, 0, 1)


def window_starts(length: int, tokens: int) -> Int[Tensor, " n"]:
    """Compute the first patches of evenly spaced windows over `length` patches, overlapping by ≥ 1/4."""
    shared = round(_OVERLAP * tokens)
    count = max(math.ceil((length - shared) / (tokens - shared)), 1)
    return torch.linspace(0, max(length - tokens, 0), count).round().long()
