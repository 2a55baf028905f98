"""Crop pyramid: a photo's CLIP target as the mean over scales of square crops; a budget of their number."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.common.memory import with_less_memory
from lang3dxl_ns.preparation.physical_scale import SMALLEST_CROP, crop_sides, fine_crops
from lang3dxl_ns.preparation.settings import Quality


@dataclass(frozen=True)
class ClipTarget:
    """Image embeddings of a photo's crops, averaged over the scales, on the grid of the smallest scale.

    Cell (i, j) of the Hd × Wd grid is centered at the photo's pixel ((j + 0.5) W / Wd, (i + 0.5) H / Hd).
    """

    features: Float[Tensor, "hd wd c"]
    """Mean embedding, float32 unless stored, as output by the encoder (not normalized)."""
    valid: Float[Tensor, "hd wd"]
    """Mean share of the crops' area inside the photo, 0..1; the rest of a crop is black."""


_MOST_SHRUNK = 47
"""Largest factor by which CUDA's antialiased bicubic resize can shrink."""
HALF, THIRD = 2, 3
"""Spacing of crops: the number of steps from center to center that make up a crop's side."""
MOST_CROPS: dict[Quality, float] = {"fast": 700, "normal": 2_500, "fine": math.inf}
"""Maximum number of crops per photo for an encoder of 224 pixels, by quality. An encoder of half the side may
have four times as many, which take about as long."""
USUAL_INPUT = 224
"""Side of an encoder's input for which `MOST_CROPS` holds, in pixels."""
_LEAST_SHARE = 1 / 4
"""Smallest side of a crop, as a share of the encoder's input; a crop that is enlarged more is a blur."""
_GROWTH = 1.05
"""Factor by which crops are enlarged until there are few enough."""


def crop_count(length: int, side: int, steps: int = HALF) -> int:
    """Count the crops along an axis of `length` pixels."""
    return max(length // max(2 * _half(side) // steps, 1), 1)


def crop_centers(length: int, side: int, steps: int = HALF) -> Int[Tensor, " n"]:
    """Compute the pixel positions of the crop centers along an axis of `length` pixels. They are the middles
    of equal cells, like a target's, about `side` / `steps` apart. A crop covers `side // 2` pixels to either
    side of its center and may extend beyond the photo. Method: Lang3D-XL, crop grid; there the centers are
    exactly half a crop apart, and up to half a cell off their cells' middles."""
    count = crop_count(length, side, steps)
    return ((2 * torch.arange(count) + 1) * length + count - 1) // (2 * count)  # rounded


def valid_fractions(height: int, width: int, side: int, steps: int = HALF) -> Float[Tensor, "ny nx"]:
    """Compute the fraction of each crop's area that lies inside a photo of `height` × `width` pixels."""
    return torch.outer(_inside(height, side, steps), _inside(width, side, steps))


def iterate_crops(
    photo: Float[Tensor, "h w 3"], side: int, size: int, batch_size: int, steps: int = HALF
) -> Iterator[Float[Tensor, "n 3 s s"]]:
    """Yield the photo's crops, row by row from the top left, at `size` pixels, `batch_size` at a time, black
    outside the photo. CLIP's own antialiased bicubic resize is used, then clamped to 0..1; what it would
    shrink too far is averaged first."""
    windows, tops, lefts = _windows(photo, side, steps)
    columns = len(lefts)
    for batch in torch.arange(len(tops) * columns, device=photo.device).split(batch_size):
        crops = windows[:, tops[batch // columns], lefts[batch % columns]].transpose(0, 1)
        if (parts := -(-crops.shape[-1] // (_MOST_SHRUNK * size))) > 1:
            smaller = crops.shape[-1] // parts
            crops = F.interpolate(crops, (smaller, smaller), mode="area")
        if crops.shape[-1] != size:
            crops = F.interpolate(crops, (size, size), mode="bicubic", align_corners=False, antialias=True)
        yield crops.clamp(0, 1)


@torch.no_grad()
def build_clip_target(
    photo: Float[Tensor, "h w 3"],
    crop_sides: Sequence[int],
    encode: Callable[[Float[Tensor, "n 3 s s"]], Float[Tensor, "n c"]],
    crop_size: int,
    batch_size: int,
    steps: int = HALF,
) -> ClipTarget:
    """Encode the crops of every scale and average the scales on the finest scale's grid. `photo` is RGB in
    0..1, `crop_sides` has one side in pixels per scale, and `encode` takes crops of `crop_size` pixels in
    0..1. `steps` is the spacing of the finest scale's crops; others have two steps per side. All scales have
    equal weight. Method: Lang3D-XL, average over scales."""
    finest = valid_fractions(photo.shape[0], photo.shape[1], min(crop_sides), steps).shape
    total = torch.zeros(())
    for side in crop_sides:
        own_steps = steps if side == min(crop_sides) else HALF
        grid = _encode_scale(photo, side, encode, crop_size, batch_size, own_steps)
        total = total + F.interpolate(grid[None], finest, mode="bilinear", align_corners=False)[0]
    mean = (total / len(crop_sides)).permute(1, 2, 0)
    return ClipTarget(mean[..., :-1].contiguous(), mean[..., -1].contiguous())


def _encode_scale(
    photo: Float[Tensor, "h w 3"],
    side: int,
    encode: Callable[[Tensor], Tensor],
    crop_size: int,
    batch_size: int,
    steps: int,
) -> Float[Tensor, "c+1 ny nx"]:
    """Encode one scale's crops to a grid of embeddings, with the valid fraction as the last channel; batches
    become smaller if memory runs out."""

    def encoded(batch: int) -> Tensor:
        crops = iterate_crops(photo, side, crop_size, batch, steps)
        return torch.cat([encode(part).float() for part in crops])

    features = with_less_memory(encoded, batch_size)
    valid = valid_fractions(photo.shape[0], photo.shape[1], side, steps).to(features)
    return torch.cat([features.T.unflatten(1, valid.shape), valid[None]])


def _half(side: int) -> int:
    """Return half of a crop's side, rounded down. Raises ValueError for a side of less than 2 pixels."""
    if side < 2:
        raise ValueError(f"a crop needs a side of at least 2 pixels, not {side}")
    return side // 2


def _inside(length: int, side: int, steps: int) -> Float[Tensor, " n"]:
    """Compute the fraction of each crop that lies inside the photo along one axis."""
    half, centers = _half(side), crop_centers(length, side, steps)
    return ((centers + half).clamp(max=length) - (centers - half).clamp(min=0)) / (2 * half)


def _windows(
    photo: Float[Tensor, "h w 3"], side: int, steps: int
) -> tuple[Float[Tensor, "3 H W t t"], Int[Tensor, " ny"], Int[Tensor, " nx"]]:
    """Return a crop at every pixel (views of the photo padded with black, which take no memory each), and the
    rows and columns at which the required crops begin."""
    half = _half(side)
    padding: list[int] = []
    starts = []
    for length in (photo.shape[1], photo.shape[0]):  # F.pad counts from the last axis, the width
        centers = crop_centers(length, side, steps).to(photo.device)
        before = max(0, half - int(centers[0]))
        padding += [before, max(0, int(centers[-1]) + half - length)]
        starts.append(centers - half + before)
    padded = F.pad(photo.permute(2, 0, 1), padding)
    lefts, tops = starts
    return padded.unfold(1, 2 * half, 1).unfold(2, 2 * half, 1), tops, lefts


@dataclass(frozen=True)
class Crops:
    """Sizes and spacing of a photo's crops."""

    sides: list[int]
    """Sides of the crops in pixels, ascending."""
    steps: int
    """Spacing of the smallest crops: this many steps make up a side. Others have two."""

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Count the rows and columns of the smallest crops in a photo of `height` × `width` pixels."""
        side = self.sides[0]
        return crop_count(height, side, self.steps), crop_count(width, side, self.steps)

    def count(self, height: int, width: int) -> int:
        """Count the crops in a photo of `height` × `width` pixels."""
        larger = sum(crop_count(height, side) * crop_count(width, side) for side in self.sides[1:])
        return math.prod(self.grid(height, width)) + larger


def choose_crops(
    scales: Sequence[float],
    pixel_size: float,
    size: tuple[int, int],
    is_fine: bool,
    input_side: int,
    quality: Quality,
) -> Crops:
    """Choose a photo's crops: those of the scales, without crops too small for the encoder. If there are more
    than the quality allows, fine crops first move apart, from a third to half of their side; then all grow.

    Args:
        scales: sides in world units, or in photo widths.
        pixel_size: world units per pixel of the photo; 1 / width for relative scales.
        size: width and height of the photo in pixels.
        is_fine: whether to cut small crops alone (`fine_crops`) instead of the whole pyramid.
        input_side: side of the encoder's input in pixels.
        quality: bound on the number; "fine" has no bound, and allows crops down to 32 pixels.
    """
    width, height = size
    most = MOST_CROPS[quality] * (USUAL_INPUT / input_side) ** 2
    least = 0.0 if quality == "fine" else _LEAST_SHARE * input_side
    smallest = float(SMALLEST_CROP)
    while True:
        sides = crop_sides(scales, pixel_size, width, smallest)
        if is_fine:
            sides = fine_crops(sides[0])
        if sides[0] >= min(least, width):
            for steps in (THIRD, HALF) if is_fine else (HALF,):
                crops = Crops(sides, steps)
                if crops.count(height, width) <= most or smallest >= width:
                    return crops
        if smallest >= width:
            return Crops(sides, HALF)
        smallest = max(smallest, sides[-1] if is_fine else sides[0]) * _GROWTH
