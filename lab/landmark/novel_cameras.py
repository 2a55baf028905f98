"""Cameras of a landmark's test views: sampled like the photos', until every category appears often enough."""

from __future__ import annotations

import numpy as np

from lab.landmark.labels import SMALLEST_POSITIVE, category_masks
from lab.landmark.landmark import Landmark
from lab.landmark.photography import plain_view, random_camera
from lab.landmark.raycast import Camera
from lab.landmark.shading import trace

EACH = 5
"""Minimum number of views that show each category, or a third of the views if there are fewer than 15."""
_THUMBNAIL = 4
"""Factor by which the pictures for choosing cameras are smaller. They require twice the share that counts as
shown."""
_MOST_DRAWN = 50
"""Number of cameras sampled per requested one before any camera is accepted."""


def choose_cameras(landmark: Landmark, count: int, wild: bool, size: tuple[int, int]) -> list[Camera]:
    """Choose `count` cameras of the landmark, the same in every call. `size` is (width, height) in pixels.

    A camera is accepted if all categories can still get their views from the remaining ones.
    """
    rng = np.random.default_rng([landmark.seed, 5])
    lacking = dict.fromkeys(_categories(landmark), min(EACH, count // 3))
    cameras: list[Camera] = []
    drawn = 0
    while len(cameras) < count:
        drawn += 1
        camera = random_camera(landmark, rng, wild)
        shown = _shown(landmark, camera, size)
        left = count - len(cameras) - 1
        fits = all(need - (category in shown) <= left for category, need in lacking.items())
        if fits or drawn > _MOST_DRAWN * count:
            cameras.append(camera)
            lacking = {category: need - (category in shown) for category, need in lacking.items()}
    return cameras


def _categories(landmark: Landmark) -> list[str]:
    """List the categories that the landmark contains."""
    parts = np.array([shape.part for shape in landmark.shapes])
    elements = np.array([shape.element for shape in landmark.shapes])
    return [category for category, found in category_masks(parts, elements).items() if found.any()]


def _shown(landmark: Landmark, camera: Camera, size: tuple[int, int]) -> set[str]:
    """Find the categories visible from a camera."""
    width, height = (max(length // _THUMBNAIL, 1) for length in size)
    seen = trace(landmark.shapes, camera, plain_view(camera).weather, width, height)
    masks = category_masks(seen.spread(seen.part), seen.spread(seen.element))
    return {category for category, mask in masks.items() if mask.mean() >= 2 * SMALLEST_POSITIVE}
