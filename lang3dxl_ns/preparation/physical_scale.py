"""Sizes of crops: world units per pixel of each photo, crop sides in world units, and their choice.

Everything here is in units of the original COLMAP model. Poses that a trainer has recentered and rescaled
must not be used here, because the scale ranges would lose their meaning.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from lang3dxl_ns.common.console import some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.common.presets import load_preset
from lang3dxl_ns.preparation.settings import AngleRule, DistanceRule, PreparationConfig
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto
from lang3dxl_ns.scene.photo import Photo

SMALLEST_CROP = 32
"""Smallest side of a crop in pixels; smaller ones contain too little for an image encoder."""
FINE_SHARE = 0.7
"""Side of the finest crops relative to the pyramid's smallest; chosen by measurement (docs/lab/words.md)."""
EDGE_MARGIN = 0.1
"""Margin, as a share of a photo's side, in which the "mean-inner" distance ignores observations."""

SCALE_RATIO = 1.6
"""Ratio of the widths that far and near photos show up to which one pyramid of fixed size suffices. Each
photo is then within half a level of the middle one (levels are √2 apart)."""


@dataclass(frozen=True)
class ScaleRange:
    """Sides of the smallest and the largest crop in world units, with a sentence that explains them."""

    smallest: float
    largest: float
    reason: str


def pixel_size(
    photo: TrackedPhoto, distance: DistanceRule = "median", angle: AngleRule = "half"
) -> float | None:
    """Compute the world units that a pixel of the photo shows at the distance of its tracked points.

    The result averages width and height. It is None if the photo has no tracked points in front of the
    camera. Method: Lang3D-XL, physical scale.

    Args:
        photo: the photo with its tracked points.
        distance: "median" is the camera's distance to the points' median (per camera axis), robust against
            outliers; "mean" to their mean; "mean-inner" to the mean without points near edges (the paper).
        angle: "half" is 2 d tan(θ/2) with θ the full field of view over the pixels, as assumed by the
            published scale ranges; "paper" is the paper's text, 2 d tan θ with θ = arctan(W / f) / W; "exact"
            is the pinhole's d / f.
    """
    d = _subject_distance(photo, distance)
    if d is None:
        return None
    lens = photo.lens
    across = _footprint(lens.width, lens.fx, d, angle)
    return (across + _footprint(lens.height, lens.fy, d, angle)) / 2


def pixel_sizes(
    reconstruction: Reconstruction, distance: DistanceRule = "median", angle: AngleRule = "half"
) -> tuple[dict[str, float], list[str]]:
    """Compute every photo's pixel size, and list the photos for which it is a fallback: one without tracked
    points is measured by the points in its view; without those, it gets the median of the others. Raises
    UserError if no photo can be measured."""
    photos = reconstruction.photos
    sizes = {name: pixel_size(photo, distance, angle) for name, photo in photos.items()}
    untracked = [name for name, size in sizes.items() if size is None]
    for name in untracked:
        sizes[name] = pixel_size(_track_all_in_view(reconstruction.points, photos[name]), distance, angle)
    known = [size for size in sizes.values() if size is not None]
    if not known:
        raise UserError(
            f"no photo sees a 3D point ({len(sizes)} photos, {len(reconstruction.points)} points): "
            "sizes in the world are unknown. Triangulate (colmap point_triangulator) or use relative scales"
        )
    median = float(np.median(known))
    return {name: median if size is None else size for name, size in sizes.items()}, untracked


def physical_scales(smallest: float, largest: float) -> list[float]:
    """List crop sides in world units, geometric from `smallest` to `largest`, both included:
    round(log_√2(largest / smallest)) of them, at least 1 (then the smallest alone). Raises UserError for an
    empty range. Method: Lang3D-XL, scale list."""
    if not 0 < smallest <= largest < math.inf:
        raise UserError(
            f"scale range {smallest}–{largest} is empty: give 0 < smallest ≤ largest, in world units"
        )
    count = max(1, round(2 * (math.log2(largest) - math.log2(smallest))))
    return np.geomspace(smallest, largest, count).tolist()


def relative_scales(count: int = 7, smallest: float = 0.05, largest: float = 0.5) -> list[float]:
    """List crop sides as fractions of the photo's width, by default over LERF's range."""
    return np.geomspace(smallest, largest, count).tolist()


def crop_sides(
    scales: Sequence[float], pixel_size: float, width: int, smallest: float = SMALLEST_CROP
) -> list[int]:
    """Convert scales to crop sides in pixels of a photo of `width` pixels, ascending. Sides are clipped to
    `smallest` … `width` pixels, and 2 at least. Duplicates are dropped, so a photo can have fewer sides than
    there are scales. For relative scales, the pixel size is 1 / width."""
    sides = (min(max(scale / pixel_size, smallest), max(width, 2)) for scale in sorted(scales))
    return list(dict.fromkeys(math.floor(side + 1e-6) for side in sides))  # 0.47 / 0.01 is 46.99…


def fine_crops(side: int) -> list[int]:
    """List the sides in pixels of fine crops: `side`, the smallest of a pyramid, and a smaller one."""
    return [max(round(FINE_SHARE * side), 2), side]


def propose_scale_range(reconstruction: Reconstruction, pixel_sizes: dict[str, float]) -> ScaleRange:
    """Propose a scale range for a scene without a hand-made one, from the widths that its photos show.

    The smallest crop is 1/20 of the median photo's width in the world, about a window on a building that
    fills the photo, and at least 32 pixels there. The largest is half of the wider photos' (75th percentile),
    but no larger than the building (the sphere that contains 80 % of the points). Their ratio stays within
    4.5–16, as in the published hand-made ranges.
    """
    widths = np.array([photo.width for photo in reconstruction.photos.values()])
    sizes = np.array([pixel_sizes[name] for name in reconstruction.photos])
    typical, wide = np.quantile(widths * sizes, [0.5, 0.75])
    building = _extent(reconstruction.points)
    smallest = float(max(typical / 20, SMALLEST_CROP * np.median(sizes)))
    largest = float(np.clip(min(wide / 2, building), 4.5 * smallest, 16 * smallest))
    reason = (
        f"crops of {smallest:.3g}–{largest:.3g} world units: the median photo sees {typical:.3g} across "
        f"({smallest / np.median(sizes):.0f} pixels make the smallest crop), a quarter of the photos "
        f"{wide:.3g} or more, and the building measures about {building:.3g}"
    )
    return ScaleRange(smallest, largest, reason)


def _extent(points: Float[Array, "m 3"]) -> float:
    """Compute the diameter of the sphere around the median point that contains 80 % of the points."""
    return 2 * float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.8))


def _subject_distance(photo: TrackedPhoto, rule: DistanceRule) -> float | None:
    """Compute the distance from the camera to the middle of its tracked points in the camera's frame (a
    per-axis median depends on the frame); None without a usable one. Points behind the camera can't be seen,
    so such tracks are wrong and ignored."""
    if len(photo.pixels) != len(photo.points):  # points in view, not tracked ones
        photo = _track_all_in_view(photo.points, photo)
    points = (photo.points - photo.center) @ photo.camera_from_world[:, :3].T
    in_front = points[:, 2] > 0
    points = points[in_front]
    if rule == "mean-inner":
        size = np.array([photo.width, photo.height])
        inner = (np.abs(photo.pixels[in_front] / size - 0.5) < 0.5 - EDGE_MARGIN).all(axis=1)
        points = points[inner] if inner.any() else points
    if not len(points):
        return None
    middle = np.median(points, axis=0) if rule == "median" else points.mean(axis=0)
    d = float(np.linalg.norm(middle))
    return d if 0 < d < math.inf else None


def _footprint(length: int, focal: float, distance: float, rule: AngleRule) -> float:
    """Compute the world units per pixel along an axis of `length` pixels."""
    if rule == "exact":
        return distance / focal
    if rule == "paper":
        return 2 * distance * math.tan(math.atan(length / focal) / length)
    return 2 * distance * math.tan(math.atan(length / (2 * focal)) / length)


def _track_all_in_view(points: Float[Array, "m 3"], photo: TrackedPhoto) -> TrackedPhoto:
    """Return the photo with all points in its view instead of its tracked ones."""
    lens = photo.lens
    x, y, z = photo.camera_from_world @ np.column_stack([points, np.ones(len(points))]).T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels = np.column_stack([lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy])
    inside = (z > 0) & ((pixels >= 0) & (pixels <= [photo.width, photo.height])).all(axis=1)
    return replace(photo, points=points[inside], pixels=pixels[inside])


# ── the choice for a scene ──────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class CropPlan:
    """Crop sizes of the photos, with the reasons for them."""

    scales: list[float]
    """Sides of the crops, ascending, in world units or fractions of a photo's width."""
    pixel_sizes: dict[str, float] | None
    """World units per pixel of each photo as it is read; None if the scales are fractions."""
    spread: float | None
    """Ratio of the widths that photos show, 95th over 5th percentile; None without 3D points."""
    reasons: list[str]


def plan_crops(
    photos: Sequence[Photo], reconstruction: Reconstruction, config: PreparationConfig
) -> CropPlan:
    """Choose crop sizes, which are configured or proposed from the scene. Crops have one size in the world,
    unless relative sizes are configured, the scene has no 3D points to measure with, or (under "auto") its
    photos are so similar in scale that one size in the photo is equivalent (`SCALE_RATIO`). Raises UserError
    for physical sizes without 3D points, also where a configured range can be nothing else."""
    if config.scale_mode == "physical" and not len(reconstruction.points):
        raise UserError(
            "crops of physical size need 3D points, and the scene has none: reconstruct it with COLMAP, or "
            f"pass {data_option('scale-mode')} auto"
        )
    if config.scale_mode == "relative" or not len(reconstruction.points):
        replace(config, scale_mode="relative").check()  # a configured range may be meant in world units
        scales = _resampled(relative_scales(7, *(config.scale_range or ())), config)
        reasons = [f"crops of {_listed(scales)} of the photo's width"]
        if config.scale_mode != "relative":
            reasons.insert(0, "the scene has no 3D points: crop sizes are relative to the photo")
        return CropPlan(scales, None, None, reasons)
    sizes, untracked = pixel_sizes(reconstruction, config.pixel_distance, config.pixel_angle)
    chosen = _scale_range(config, reconstruction, sizes)
    scales = _resampled(physical_scales(chosen.smallest, chosen.largest), config)
    reasons = [f"{chosen.reason}; crop sides: {_listed(scales)} ({data_option('scale-range')} overrides)"]
    if untracked:
        reasons.append(
            f"{len(untracked)} photos have no tracked points: their scale is that of the points in view, "
            f"or the scene's median: {some(untracked)}"
        )
    # The reconstruction's sizes are per pixel of the model's photos; a file may be a resized copy.
    widths = [sizes[photo.name] * reconstruction.photos[photo.name].width for photo in photos]
    per_file_pixel = {photo.name: width / photo.width for photo, width in zip(photos, widths, strict=True)}
    low, middle, high = np.percentile(widths, (5, 50, 95)).tolist()
    spread = high / low
    if config.scale_mode == "auto" and spread <= SCALE_RATIO:
        fractions = [scale / middle for scale in scales]
        reasons.append(f"photos agree in scale: fixed crops of {_listed(fractions)} of their width")
        return CropPlan(fractions, None, spread, reasons)
    return CropPlan(scales, per_file_pixel, spread, reasons)


def _scale_range(
    config: PreparationConfig, reconstruction: Reconstruction, sizes: dict[str, float]
) -> ScaleRange:
    if config.scale_preset is not None:
        settings = load_preset(config.scale_preset)
        if "scale_range" not in settings:
            raise UserError(f"the preset {config.scale_preset} has no scale-range: choose a scene's")
        smallest, largest = settings["scale_range"]
        reason = f"crops of {smallest}–{largest} world units ({config.scale_preset})"
        return ScaleRange(smallest, largest, reason)
    if config.scale_range is None:
        return propose_scale_range(reconstruction, sizes)
    smallest, largest = config.scale_range
    return ScaleRange(smallest, largest, f"crops of {smallest:.3g}–{largest:.3g} world units, as configured")


def _resampled(scales: list[float], config: PreparationConfig) -> list[float]:
    """Space the configured number of sizes evenly (by ratio) over the same range; one gets the middle."""
    if config.scales is None:
        return scales
    if config.scales == 1:
        return [math.sqrt(scales[0] * scales[-1])]
    return np.geomspace(scales[0], scales[-1], config.scales).tolist()


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
