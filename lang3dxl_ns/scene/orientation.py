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
    """Turn a model's photo upright, whose file has a `size` (width, height) and `quarter_turns` as stored.
    Lens, pose and tracks are turned with the pixels. If the program that made the model had turned the photos
    already, the shape of the model's camera differs from the stored pixels', and all are kept."""
    width, height = size
    fits_stored = (tracked.width > tracked.height) == (width > height)
    lens, pixels, camera = tracked.lens, tracked.pixels, tracked.camera_from_world
    for _ in range(quarters if fits_stored or width == height or quarters % 2 == 0 else 0):
        pixels = np.column_stack([lens.height - pixels[:, 1], pixels[:, 0]])
        lens, camera = turned_lens(lens, 1), _QUARTER @ camera
    return replace(tracked, lens=lens, camera_from_world=camera, pixels=pixels, quarter_turns=quarters)
