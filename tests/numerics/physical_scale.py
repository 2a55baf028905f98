"""Hard cases of the physical scale: pixel sizes and crop sizes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import get_args

import numpy as np
import torch
from numpy import ndarray as Array

from lab.numerics.measure import Bounds, Case, Problem
from lang3dxl_ns.preparation.physical_scale import crop_sides, physical_scales, pixel_size
from lang3dxl_ns.preparation.settings import AngleRule, DistanceRule
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.colmap import TrackedPhoto

LONG = np.longdouble
BOUNDS = {"float64": Bounds(1e-12, 1e-12)}
OFFSET = {"float64": Bounds(1e-9, 1e-9)}


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Pixel sizes by every rule against 80-bit arithmetic; and crops."""
    photo = _photo()
    points = photo.points
    behind = photo.center - (points - photo.center)
    photos: dict[str, TrackedPhoto] = {
        "usual": photo,
        "no point": replace(photo, points=points[:0], pixels=photo.pixels[:0]),
        "one point": replace(photo, points=points[:1], pixels=photo.pixels[:1]),
        "a point at the camera center": replace(photo, points=photo.center[None], pixels=photo.pixels[:1]),
        "some points behind the camera": replace(photo, points=np.concatenate([points, behind[:20]]),
                                                 pixels=np.concatenate([photo.pixels, photo.pixels[:20]])),
        "all points behind the camera": replace(photo, points=behind),
        "one outlier at 1e9": replace(photo, points=np.concatenate([points, [[1e9, 1e9, 1e9]]]),
                                      pixels=np.concatenate([photo.pixels, [[300.0, 200.0]]])),
        "1×4000 pixels": photo.resized(1, 4000),
    }  # fmt: skip
    for ratio in (0.01, 0.1, 10, 100):
        photos[f"W/f = {ratio:g}"] = _with_focal(photo, photo.width / ratio)
    for name, one in photos.items():
        yield Case("physical scale", name, _sizes(one), BOUNDS)
    moved = {"scale 1e-3": (1e-3, 0.0), "scale 1e5": (1e5, 0.0), "offset 1e6 (UTM)": (1.0, 1e6)}
    for name, (scale, offset) in moved.items():
        note = "a camera center of 1e6 has ten digits behind the point" if offset else ""
        yield Case("physical scale", name, _sizes(in_world(photo, scale, offset)), OFFSET, note)
    yield Case("physical scale", "crops and scale list", _crops, BOUNDS)
    yield Case("physical scale", "scales from 1e-300 to 1e300", _extreme_scales, BOUNDS)


def _photo(width: int = 640, height: int = 480) -> TrackedPhoto:
    """A photo, from 5 units away, of 200 points on a wall of 3 × 2."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.5, -1, 4.8], [1.5, 1, 5.2], (200, 3))
    focal = 0.9 * width
    pixels = focal * points[:, :2] / points[:, 2:] + [width / 2, height / 2]
    pose = np.hstack([np.eye(3), np.zeros((3, 1))])
    lens = Lens(width, height, focal, focal, width / 2, height / 2)
    return TrackedPhoto("wall", lens, pose, points, pixels)


def _with_focal(photo: TrackedPhoto, focal: float) -> TrackedPhoto:
    return replace(photo, lens=replace(photo.lens, fx=focal, fy=focal))


def in_world(photo: TrackedPhoto, scale: float, offset: float) -> TrackedPhoto:
    """The photo in a rotated, scaled and moved world: x' = scale · R x + offset · (0.48, 4.6, 0.1)."""
    x, y = 0.7, -0.4
    turn_x = np.array([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]])
    turn_y = np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    rotation = turn_x @ turn_y
    origin = offset * np.array([0.48, 4.6, 0.1])
    pose = photo.camera_from_world[:, :3] @ rotation.T
    translation = scale * photo.camera_from_world[:, 3] - pose @ origin
    return replace(
        photo,
        camera_from_world=np.column_stack([pose, translation]),
        points=scale * photo.points @ rotation.T + origin,
    )


def _numbers(values: Callable[[], list[float]], expected: Callable[[], list[float]]) -> Callable[[], Problem]:
    """A problem without leaves: two lists of numbers that should agree."""

    def problem() -> Problem:
        return Problem(
            {},
            lambda _: {"values": torch.tensor(values(), dtype=torch.float64)},
            lambda _: {"values": torch.tensor(expected(), dtype=torch.float64)},
        )

    return problem


def _sizes(photo: TrackedPhoto) -> Callable[[], Problem]:
    """The pixel size by every pair of rules; NaN where it cannot be measured."""
    rules = [(distance, angle) for distance in get_args(DistanceRule) for angle in get_args(AngleRule)]

    def measured() -> list[float]:
        found = [pixel_size(photo, distance, angle) for distance, angle in rules]
        # A missing value must be missing in both; −1 makes it comparable.
        return [-1.0 if size is None else size for size in found]

    return _numbers(measured, lambda: [pixel_size_reference(photo, *rule) for rule in rules])


def pixel_size_reference(photo: TrackedPhoto, distance: DistanceRule, angle: AngleRule) -> float:
    """Lang3D-XL's pixel size in 80-bit arithmetic; −1 where it cannot be measured."""
    pose, points = photo.camera_from_world.astype(LONG), photo.points.astype(LONG)
    points = points @ pose[:, :3].T + pose[:, 3]
    in_front = points[:, 2] > 0
    points, pixels = points[in_front], photo.pixels[in_front]
    if distance == "mean-inner":
        inner = (np.abs(pixels / [photo.width, photo.height] - 0.5) < 0.4).all(axis=1)
        points = points[inner] if inner.any() else points
    if not len(points):
        return -1.0
    middle = _median(points) if distance == "median" else points.sum(axis=0) / len(points)
    d = np.sqrt((middle**2).sum())
    sizes = []
    for length, focal in ((photo.width, photo.lens.fx), (photo.height, photo.lens.fy)):
        ratio = LONG(length) / LONG(focal)
        sizes.append(
            {
                "half": 2 * d * np.tan(np.arctan(ratio / 2) / length),
                "paper": 2 * d * np.tan(np.arctan(ratio) / length),
                "exact": d / LONG(focal),
            }[angle]
        )
    return float((sizes[0] + sizes[1]) / 2)


def _median(points: Array) -> Array:
    ordered = np.sort(points, axis=0)
    n = len(ordered)
    return (ordered[(n - 1) // 2] + ordered[n // 2]) / 2


def _crops() -> Problem:
    """Scale lists by their definition, and crop sides for extreme pixel sizes."""

    def computed() -> list[float]:
        sides = [crop_sides([0.3, 1.0], size, 640) for size in (1e-300, 1e-9, 1e-3, 1e9, 1e300)]
        return physical_scales(0.2, 3.0) + [float(side) for group in sides for side in group]

    scales = [float(LONG(0.2) * LONG(15) ** (LONG(i) / 7)) for i in range(8)]
    return _numbers(computed, lambda: [*scales, 640, 640, 300, 640, 32, 32])()


def _extreme_scales() -> Problem:
    def computed() -> list[float]:
        found = physical_scales(1e-300, 1e300)
        return [len(found), found[0] * 1e300, found[-1] / 1e300]

    return _numbers(computed, lambda: [round(2 * 600 * math.log2(10)), 1, 1])()
