"""Choice of the crops' sizes for a photo collection, with the reasons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lang3dxl_ns.common.console import some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.presets import load_preset
from lang3dxl_ns.preparation.model_files import spoken
from lang3dxl_ns.preparation.physical_scale import (
    ScaleRange,
    physical_scales,
    pixel_sizes,
    propose_scale_range,
    relative_scales,
)
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene.colmap import Reconstruction
from lang3dxl_ns.scene.photo import Photo

SCALE_RATIO = 1.6
"""Ratio of the widths that far and near photos show up to which one pyramid of fixed size suffices. Each
photo is then within half a level of the middle one (levels are √2 apart)."""


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
            "pass --pipeline.datamanager.scale-mode auto"
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
    reasons = [
        f"{chosen.reason}; crop sides: {_listed(scales)} "
        f"({spoken('--pipeline.datamanager.scale-range')} overrides)"
    ]
    if untracked:
        reasons.append(
            f"{len(untracked)} photos have no tracked points: their scale is that of the points in view, "
            f"or the scene's median: {some(untracked)}"
        )
    # The reconstruction's sizes are per pixel of the model's photos; a file may be a resized copy.
    per_file_pixel = {p.name: sizes[p.name] * reconstruction.photos[p.name].width / p.width for p in photos}
    low, high = np.percentile([per_file_pixel[p.name] * p.width for p in photos], (5, 95))
    spread = float(high / low)
    if config.scale_mode == "auto" and spread <= SCALE_RATIO:
        width = float(np.median([per_file_pixel[p.name] * p.width for p in photos]))
        fractions = [scale / width for scale in scales]
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
