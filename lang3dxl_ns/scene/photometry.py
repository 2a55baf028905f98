"""Photometric variation across photos: exposure, tint and view dependence of tracked 3D points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.colmap import Reconstruction
from lang3dxl_ns.scene.photo import Photo

_SIDE = 512  # longer side in pixels at which colors are read, so that a pixel averages a patch of the surface
_DARK, _BRIGHT = 0.03, 0.97  # beyond these, sensors do not record brightness faithfully
_GAMMA = 2.2
_FEWEST_POINTS = 20
_MOST_PHOTOS = 60
_FEWEST_VIEWS = 6  # of a point, for a linear function of direction and a remainder


@dataclass(frozen=True)
class Photometry:
    """Agreement of photos on the colors of the same points, in natural logarithms of linear light."""

    spread: float
    """Standard deviation of the photos' exposures and tints (per channel); 0 if they agree, 0.7 is a stop."""
    view_dependence: float
    """Share of the residuals' variance, 0…1, that a linear function of the viewing direction explains beyond
    chance. Highlights and sheen raise it."""


def measure_photometry(photos: Sequence[Photo], reconstruction: Reconstruction) -> Photometry | None:
    """Fit log color = point + photo (robust per photo) to at most 60 photos, evenly spaced. Unreadable
    photos are skipped. The result is None if fewer than three photos share enough tracked points."""
    rows: list[tuple[Array, ...]] = []
    for photo in photos[:: max(-(-len(photos) // _MOST_PHOTOS), 1)]:
        tracked = reconstruction.photos.get(photo.name)
        if tracked is None or len(tracked.points) < _FEWEST_POINTS:
            continue
        if len(tracked.pixels) != len(tracked.points):  # a scene without tracks
            continue
        try:
            colors, usable = _log_colors(photo, tracked.pixels / [tracked.width, tracked.height])
        except UserError:
            continue
        rays = tracked.points - tracked.center
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True).clip(1e-12)
        index = np.full(len(rays), len(rows))
        rows.append(tuple(values[usable] for values in (tracked.points, index, colors, rays)))
    if len(rows) < 3:
        return None
    points, photo_index, color, ray = map(np.concatenate, zip(*rows, strict=True))
    point = np.unique(points, axis=0, return_inverse=True)[1].ravel()
    shared = np.bincount(point)[point] >= 2
    if shared.sum() < 2 * _FEWEST_POINTS:
        return None
    return _fit(point[shared], photo_index[shared], color[shared], ray[shared])


def _log_colors(photo: Photo, places: Float[Array, "n 2"]) -> tuple[Float[Array, "n 3"], Array]:
    """Read log linear RGB at `places` (fractions of width and height), and where it is well exposed."""
    pixels = photo.read_file(_SIDE).double().numpy() / 255
    height, width = pixels.shape[:2]
    column = (places[:, 0] * width).astype(int).clip(0, width - 1)
    row = (places[:, 1] * height).astype(int).clip(0, height - 1)
    value = pixels[row, column]
    usable = ((value > _DARK) & (value < _BRIGHT)).all(axis=1)
    return _GAMMA * np.log(value.clip(_DARK, 1)), usable


def _fit(
    point: Int[Array, " m"], photo: Int[Array, " m"], color: Float[Array, "m 3"], ray: Float[Array, "m 3"]
) -> Photometry:
    """Alternate between the points' means and the photos' medians until both converge."""
    point, photo = (np.unique(numbers, return_inverse=True)[1] for numbers in (point, photo))
    count, groups = np.bincount(point).astype(float), _grouped(photo)

    def means() -> Float[Array, "n 3"]:
        values = color - offset[photo]
        return np.stack([np.bincount(point, values[:, c]) / count for c in range(3)], axis=1)

    offset = np.zeros((len(groups), 3))
    for _ in range(50):
        mean = means()
        new = np.stack([np.median(color[group] - mean[point[group]], axis=0) for group in groups])
        new -= new.mean(axis=0)
        change = np.abs(new - offset).max()
        offset = new
        if change < 1e-4:
            break
    residual = color - offset[photo] - means()[point]
    return Photometry(float(np.sqrt((offset**2).mean())), _explained_by_direction(point, residual, ray))


def _grouped(numbers: Int[Array, " m"]) -> list[Int[Array, " k"]]:
    """Return, for every number from 0 on, the rows that hold it."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.cumsum(np.bincount(numbers))[:-1])


def _explained_by_direction(
    point: Int[Array, " m"], residual: Float[Array, "m 3"], ray: Float[Array, "m 3"]
) -> float:
    """Compute the adjusted R² of a linear function of direction, over points seen often enough."""
    explained, total = 0.0, 0.0
    for group in (group for group in _grouped(point) if len(group) >= _FEWEST_VIEWS):
        centered = ray[group] - ray[group].mean(axis=0)
        gray = residual[group].mean(axis=1)
        gray = gray - gray.mean()
        rest = gray - centered @ np.linalg.lstsq(centered, gray, rcond=1e-3)[0]
        n = len(group)
        total += float(gray @ gray) / (n - 1)
        explained += float(gray @ gray) / (n - 1) - float(rest @ rest) / (n - 4)
    return float(np.clip(explained / total, 0, 1)) if total > 0 else 0.0
