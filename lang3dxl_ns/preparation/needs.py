"""Scene needs: measurements that decide which optional components are built."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from lang3dxl_ns.common.errors import readable
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.common.reports import markdown_table, write_report
from lang3dxl_ns.preparation.physical_scale import SCALE_RATIO, CropPlan, crop_sides
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.photometry import measure_photometry

LIGHT = 0.3
"""Spread of the photos' exposures above which appearance is needed, in natural logarithms of light. A smaller
one, below half a stop, is explained by a camera's own metering and absorbed by one color per surface."""
SHEEN = 0.4
"""Share of the residual colors explained by viewing direction above which view dependence is needed. It is
0.1 to 0.3 on matte landmarks, where haze and noise mimic sheen, and 0.5 and more on shiny ones."""
REPROJECTION = 2.0
"""Reprojection error in pixels above which cameras are optimized; COLMAP usually ends below one."""
SPREAD_OF_SCALE = "physical widths of the photos, 95th over 5th percentile"
CUT = 0.01
"""Share of the pixels removed by masks above which the foreground is needed."""

_MASKS = 20
"""Most masks that are measured, evenly spaced."""
NEEDS_FILE = "scene_needs"


@dataclass(frozen=True)
class Need:
    """Optional component with its measurement and the verdict."""

    component: str
    needed: bool
    measured: str
    """Description of the measured quantity."""
    value: float | None
    """Measured value; None if nothing could be measured."""
    threshold: float | None
    """Value above which the component is needed; None if no number decides."""

    @property
    def verdict(self) -> str:
        return "needed" if self.needed else "left out"


_DENSE = "a dense encoder is given, which sharpens words"


def scene_needs(
    photos: Sequence[Photo], reconstruction: Reconstruction, crops: CropPlan, dense: bool, regions: bool
) -> list[Need]:
    """Measure the need for every optional component, which takes seconds for a hundred photos. `dense` and
    `regions`: whether the configuration has a dense encoder, and a source of regions."""
    light = measure_photometry(photos, reconstruction)
    # Levels are clipped to 32 pixels and to the photo; duplicates are never made.
    sizes = {p.name: 1 / p.width for p in photos} if crops.pixel_sizes is None else crops.pixel_sizes
    levels = float(np.mean([len(crop_sides(crops.scales, sizes[p.name], p.width)) for p in photos]))
    errors = [error for photo in reconstruction.photos.values() if (error := _reprojection_error(photo))]
    return [
        _measured(
            "appearance", "spread of the photos' exposures along tracks (log of light)",
            None if light is None else light.spread, LIGHT,
        ),
        _measured(
            "view dependence", "share of the tracks' color residuals explained by the viewing direction",
            None if light is None else light.view_dependence, SHEEN,
        ),
        Need("physical scale", crops.pixel_sizes is not None, SPREAD_OF_SCALE, crops.spread, SCALE_RATIO),
        _measured(
            "pyramid levels",
            f"distinct pyramid levels per photo, mean over the photos, of {len(crops.scales)}", levels, 1.0,
        ),
        _foreground(photos),
        Need("regions", regions, f"{'a' if regions else 'no'} source of regions is given", None, None),
        Need("dense features", dense, _DENSE if dense else f"no {_DENSE[2:]}", None, None),
        _measured(
            "camera optimizer", "reprojection error of the model (pixels, median over the photos)",
            float(np.median(errors)) if errors else None, REPROJECTION, unmeasured=False,
        ),
    ]  # fmt: skip


def _measured(
    component: str, measured: str, value: float | None, threshold: float, unmeasured: bool = True
) -> Need:
    """Decide whether a component is needed: above a threshold, or by default if nothing was measured."""
    return Need(component, unmeasured if value is None else value > threshold, measured, value, threshold)


def _foreground(photos: Sequence[Photo]) -> Need:
    masked = [photo for photo in photos if photo.mask_path is not None]
    if not masked:
        return Need("foreground", False, "no masks", None, None)
    cuts = []
    for photo in masked[:: -(-len(masked) // _MASKS)]:
        mask = photo.read_mask(scale=min(1.0, 256 / max(photo.width, photo.height)))
        if mask is not None:
            cuts.append(1 - float(mask.float().mean()))
    value = float(np.mean(cuts)) * len(masked) / len(photos) if cuts else None
    return _measured("foreground", "share of the pixels removed by masks", value, CUT)


def _reprojection_error(photo: TrackedPhoto) -> float | None:
    """Average the distances in pixels between a photo's keypoints and projected points; None without any."""
    import cv2

    if not len(photo.points) or len(photo.points) != len(photo.pixels):  # a scene without tracks
        return None
    rotation, translation = photo.camera_from_world[:, :3], photo.camera_from_world[:, 3]
    lens = photo.lens
    coefficients = np.array(lens.distortion or (0.0,) * 4)
    project = cv2.fisheye.projectPoints if lens.fisheye else cv2.projectPoints
    vector = cv2.Rodrigues(np.ascontiguousarray(rotation))[0]
    points: Float[Array, "n 1 3"] = np.ascontiguousarray(photo.points)[:, None]
    found = project(points, vector, translation, lens.matrix.numpy(), coefficients)[0].reshape(-1, 2)
    error = np.linalg.norm(found - photo.pixels, axis=1)
    error = error[np.isfinite(error)]
    return float(error.mean()) if len(error) else None


def needs_table(needs: Sequence[Need]) -> str:
    """Format the needs as a markdown table."""
    rows = [[n.component, n.measured, _figure(n.value), _figure(n.threshold), n.verdict] for n in needs]
    return markdown_table(["component", "measured", "value", "needed above", "verdict"], rows)


def write_needs(needs: Sequence[Need], folder: Path) -> None:
    """Write scene_needs.json and .md to the run's folder."""
    data = {n.component: {**asdict(n), "verdict": n.verdict} for n in needs}
    write_report(folder, NEEDS_FILE, f"# What this scene needs\n\n{needs_table(needs)}", data)


def read_needs(folder: Path) -> dict[str, bool]:
    """Read the verdicts in a run's folder; empty without a file. Raises UserError for a damaged file."""
    path = folder / f"{NEEDS_FILE}.json"
    if not path.is_file():
        return {}
    with readable(f"{path} can't be read", "copy it again, or remove it"):
        return {component: bool(need["needed"]) for component, need in read_json(path).items()}


def _figure(value: float | None) -> str | None:
    return None if value is None or not math.isfinite(value) else f"{value:.3g}"
