"""From a photo collection to its targets: choose the crop sizes, say why, and prepare."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.preparation.photo import Photo
from lang3dxl_ns.preparation.physical_scale import (
    Reconstruction,
    ScaleRange,
    physical_scales,
    pixel_sizes,
    propose_scale_range,
    relative_scales,
)
from lang3dxl_ns.preparation.prepare import PreparationConfig, PreparedTargets, prepare
from lang3dxl_ns.preparation.progress import some
from lang3dxl_ns.preparation.regions import RegionSource
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.presets import load_preset


def prepare_collection(
    photos: Sequence[Photo],
    reconstruction: Reconstruction,
    config: PreparationConfig,
    cache_dir: Path,
    device: torch.device | str,
    log: Callable[[str], None] = print,
    regions: RegionSource | None = None,
) -> PreparedTargets:
    """Make the missing targets of the photos in `cache_dir`; crops in the reconstruction's units.

    Physical sizes need points: without any, crops are fractions of the photo's width, and the log says so.
    """
    physical = config.scale_mode == "physical" and len(reconstruction.points) > 0
    if not physical:
        if config.scale_mode == "physical":
            log(
                "the scene has no 3D points: crops are fractions of the photo's width, not sizes in the world"
            )
        scales = relative_scales() if config.scale_range is None else relative_scales(7, *config.scale_range)
        log(f"crops of {_listed(scales)} of the photo's width")
        return prepare(photos, None, config, scales, FeatureStore(cache_dir), device, regions)
    sizes, untracked = pixel_sizes(reconstruction, config.pixel_distance, config.pixel_angle)
    if untracked:
        log(
            f"{len(untracked)} photos have no tracked points: their scale is that of the points in view, "
            f"or the scene's median: {some(untracked)}"
        )
    chosen = _scale_range(config, reconstruction, sizes)
    scales = physical_scales(chosen.smallest, chosen.largest)
    log(f"{chosen.reason}; crop sides: {_listed(scales)} (--pipeline.datamanager.scale-range overrides)")
    # The reconstruction's sizes are per pixel of the model's photos; a file may be a resized copy.
    per_file_pixel = {p.name: sizes[p.name] * reconstruction.photos[p.name].width / p.width for p in photos}
    return prepare(photos, per_file_pixel, config, scales, FeatureStore(cache_dir), device, regions)


def _scale_range(
    config: PreparationConfig, reconstruction: Reconstruction, sizes: dict[str, float]
) -> ScaleRange:
    if config.scale_preset is not None:
        smallest, largest = load_preset(config.scale_preset)["scale_range"]
        return ScaleRange(
            smallest, largest, f"crops of {smallest}–{largest} world units ({config.scale_preset})"
        )
    if config.scale_range is None:
        return propose_scale_range(reconstruction, sizes)
    smallest, largest = config.scale_range
    if not 0 < smallest <= largest:
        raise UserError(
            f"the scale range {smallest} {largest} is not a range: give the smallest crop first, both above 0"
        )
    return ScaleRange(smallest, largest, f"crops of {smallest:.3g}–{largest:.3g} world units, as asked")


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
