"""EXIF orientation: turning photos upright whose pixels are stored sideways.

Phones store the sensor's pixels, and note in EXIF how many quarter turns bring them upright. COLMAP reads the
pixels as stored. So pixels, lens and pose of a model's photo are turned together, which is exact.
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
"""Clockwise quarter turns by EXIF's orientation. Mirrored photos (2, 4, 5, 7), which no camera could have
taken, stay as stored."""
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation of a camera's frame (x right, y down) when its photo is turned clockwise by a quarter."""


def quarter_turns(image: Image.Image) -> int:
    """Return the clockwise quarter turns that bring a file's stored pixels upright; 0 without EXIF."""
    with suppress(Exception):  # damaged EXIF, which may hold anything
        return _QUARTER_TURNS.get(image.getexif().get(ExifTags.Base.Orientation, 1), 0)
    return 0


def turned_lens(lens: Lens, quarters: int) -> Lens:
    """Return the lens of a photo after clockwise quarter turns."""
    for _ in range(quarters):
        k = lens.distortion
        if len(k) >= 4 and not lens.fisheye:  # tangential coefficients are a vector; others are radial
            k = (k[0], k[1], k[3], -k[2], *k[4:])
        width, height = lens.height, lens.width
        lens = Lens(width, height, lens.fy, lens.fx, width - lens.cy, lens.cx, k, lens.fisheye)
    return lens


def upright(tracked: TrackedPhoto, size: tuple[int, int], quarters: int) -> TrackedPhoto:
    """Turn a model's photo upright: lens, pose and tracks are turned with the pixels.

    The photos may already have been turned when the model was made (by another program). Then the shape of
    the model's camera differs from the stored pixels', and lens, pose and tracks are kept.

    Args:
        tracked: the photo in the COLMAP model, whose pixels are as stored or already turned.
        size: width and height of the file's pixels as stored.
        quarters: quarter turns of the file, from `quarter_turns`.
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
