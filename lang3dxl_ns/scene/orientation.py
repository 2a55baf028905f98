"""Orientation: photos taken upright whose pixels are stored lying, as EXIF says.

Phones store the sensor's pixels and say in EXIF by how many quarter turns they are shown upright. COLMAP
reads the pixels as stored. So a model's photo is turned as a whole: pixels, lens and pose, which is exact.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from PIL import ExifTags, Image

from lang3dxl_ns.scene.camera import Lens

if TYPE_CHECKING:
    from lang3dxl_ns.scene.colmap import TrackedPhoto

_QUARTER_TURNS = {6: 1, 3: 2, 8: 3}
"""By EXIF's orientation. Mirrored photos (2, 4, 5, 7) stay as stored: no camera could have taken them."""
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Turns a camera's frame (x right, y down) with a photo that turns clockwise."""


def quarter_turns(image: Image.Image) -> int:
    """Quarter turns clockwise that bring a file's stored pixels upright; 0 without EXIF."""
    with suppress(Exception):  # damaged EXIF, which may hold anything
        return _QUARTER_TURNS.get(image.getexif().get(ExifTags.Base.Orientation, 1), 0)
    return 0


def turned_lens(lens: Lens, quarters: int) -> Lens:
    """The lens of a photo that is turned clockwise by quarters."""
    for _ in range(quarters):
        k = lens.distortion
        if len(k) >= 4 and not lens.fisheye:  # tangential coefficients are a vector; others are radial
            k = (k[0], k[1], k[3], -k[2], *k[4:])
        width, height = lens.height, lens.width
        lens = Lens(width, height, lens.fy, lens.fx, width - lens.cy, lens.cx, k, lens.fisheye)
    return lens


def upright(tracked: TrackedPhoto, size: tuple[int, int], quarters: int) -> TrackedPhoto:
    """A model's photo as it is seen upright: lens, pose and tracks turned with the pixels.

    Args:
        tracked: as COLMAP knows it, by the pixels as stored or already turned.
        size: width and height of the file's pixels as stored.
        quarters: of the file, as `quarter_turns`.

    A model of photos that were turned before (by another program) is told by its camera's shape.
    """
    width, height = size
    fits_stored = (tracked.width > tracked.height) == (width > height)
    if quarters % 2 and width != height and not fits_stored:
        return replace(tracked, quarter_turns=quarters)
    pixels, camera = tracked.pixels, tracked.camera_from_world
    across, high = tracked.width, tracked.height
    for _ in range(quarters):
        pixels = np.column_stack([high - pixels[:, 1], pixels[:, 0]])
        camera = _QUARTER @ camera
        across, high = high, across
    return replace(
        tracked,
        lens=turned_lens(tracked.lens, quarters),
        camera_from_world=camera,
        pixels=pixels,
        quarter_turns=quarters,
    )
