"""Crop budget: sizes and spacing of a bounded number of crops of a photo that an encoder can use."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lang3dxl_ns.preparation.physical_scale import SMALLEST_CROP, crop_sides, fine_crops
from lang3dxl_ns.preparation.pyramid import HALF, THIRD, crop_count
from lang3dxl_ns.preparation.settings import Quality

MOST_CROPS: dict[Quality, float] = {"fast": 700, "normal": 2_500, "fine": math.inf}
"""Maximum number of crops per photo for an encoder of 224 pixels, by quality. An encoder of half the side may
have four times as many, which take about as long."""
USUAL_INPUT = 224
"""Side of an encoder's input for which `MOST_CROPS` holds, in pixels."""
_LEAST_SHARE = 1 / 4
"""Smallest side of a crop, as a share of the encoder's input; a crop that is enlarged more is a blur."""
_GROWTH = 1.05
"""Factor by which crops are enlarged until there are few enough."""


@dataclass(frozen=True)
class Crops:
    """Sizes and spacing of a photo's crops."""

    sides: list[int]
    """Sides of the crops in pixels, ascending."""
    steps: int
    """Spacing of the smallest crops: this many steps make up a side. Others have two."""

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Count the rows and columns of the smallest crops in a photo of `height` × `width` pixels."""
        return _grid(height, width, self.sides[0], self.steps)

    def count(self, height: int, width: int) -> int:
        """Count the crops in a photo of `height` × `width` pixels."""
        larger = sum(math.prod(_grid(height, width, side, HALF)) for side in self.sides[1:])
        return math.prod(self.grid(height, width)) + larger


def choose_crops(
    scales: Sequence[float],
    pixel_size: float,
    size: tuple[int, int],
    is_fine: bool,
    input_side: int,
    quality: Quality,
) -> Crops:
    """Choose a photo's crops: those of the scales, without crops too small for the encoder.

    If there are more than the quality allows, fine crops first move apart, from a third to half of their
    side; then the crops grow.

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


def _grid(height: int, width: int, side: int, steps: int) -> tuple[int, int]:
    return crop_count(height, side, steps), crop_count(width, side, steps)
