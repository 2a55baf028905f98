"""Aggregation of scores: photos to scene, scenes to benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lang3dxl_ns.evaluation.average_precision import deviation_over_photos, mean_over_photos

PREFIXES = ("", "raw_", "authors_", "teacher_", "limit_", "chance_")
"""Which maps: the field's, unblurred, processed as published, the 2D teacher's, the lifted labels', and maps
without information."""
TOTALS = {
    "located": "localization_accuracy",
    "iou": "miou",
    "f1": "mean_f1",
    "balanced_accuracy": "mean_balanced_accuracy",
    "pixel_accuracy": "mpa",
    "precision": "mp",
    "smooth_located": "smooth_localization_accuracy",
    "smooth_iou": "smooth_miou",
    "smooth_pixel_accuracy": "smooth_mpa",
    "smooth_precision": "smooth_mp",
}
"""Measures whose total is the mean over all pairs of a photo and a category, as for LERF-OVS and PT-OVS."""
Figures = Mapping[str, float]
"""Of one photo: psnr etc., and `{prefix}{measure}_{category}`."""


def average(photos: Sequence[Figures], with_deviation: bool = False) -> dict[str, Any]:
    """Means over photos of every figure, and totals.

    `{prefix}map`: unweighted mean of average precision over the categories. `{prefix}miou`,
    `{prefix}localization_accuracy` etc.: means over all pairs of a photo and a category.
    `ap_{category}_photos`: number of photos with that category. with_deviation: adds `…_std` of every mean.
    """
    means: dict[str, Any] = mean_over_photos(photos)
    counts = {
        f"{name}_photos": sum(name in photo for photo in photos) for name in means if name.startswith("ap_")
    }
    totals = _totals(photos, means)
    if with_deviation:
        deviations = deviation_over_photos(photos)
        means = {
            key: v for name in means for key, v in ((name, means[name]), (f"{name}_std", deviations[name]))
        }
    return means | totals | counts


def _totals(photos: Sequence[Figures], means: Figures) -> dict[str, float]:
    totals: dict[str, float] = {}
    for prefix in PREFIXES:
        precision = mean_average_precision(means, prefix)
        if precision is not None:
            totals[f"{prefix}map"] = precision
        for measure, total in TOTALS.items():
            start = f"{prefix}{measure}_"
            pairs = [v for photo in photos for name, v in photo.items() if name.startswith(start)]
            if pairs:
                totals[f"{prefix}{total}"] = float(np.mean(pairs))
    return totals


def mean_average_precision(means: Figures, prefix: str = "") -> float | None:
    """Unweighted mean of the categories' APs in `means`, each a mean over photos; None if there are none."""
    found = [value for name, value in means.items() if name.startswith(f"{prefix}ap_")]
    return float(np.mean(found)) if found else None


def pool(scenes: Mapping[str, Sequence[Figures]]) -> dict[str, dict[str, Any]]:
    """Figures of several scenes together, by the two ways of reading a benchmark's table.

    `image_pooled`: `average` over the photos of all scenes, so that each photo counts alike (which fits the
    published tables of HolyScenes). `scene_mean`: mean over scenes of each scene's mean, so that each scene
    with a category counts alike; its `map` is the mean of those over categories. `per_scene`: means and
    totals of each scene.
    """
    per_scene = {name: average(photos) for name, photos in scenes.items()}
    means = mean_over_photos(
        {name: value for name, value in figures.items() if not name.endswith("_photos")}
        for figures in per_scene.values()
    )
    for prefix in PREFIXES:
        precision = mean_average_precision(means, prefix)
        if precision is not None:
            means[f"{prefix}map"] = precision
    everything = [photo for photos in scenes.values() for photo in photos]
    return {"image_pooled": average(everything), "scene_mean": means, "per_scene": per_scene}
