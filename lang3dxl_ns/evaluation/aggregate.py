"""Aggregation of scores: from photos to scene, and from scenes to benchmark."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

PREFIXES = {
    "": "blurred",
    "raw_": "unprocessed",
    "authors_": "as published",
    "teacher_": "2-D teacher",
    "limit_": "limit",
    "chance_": "chance",
}
"""Prefixes of scored maps, and their names in reports: the field's maps, the same unblurred or processed as
published, the 2D teacher's, the lifted labels', and maps without information."""
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
"""Measures whose total is the mean over all pairs of a photo and a category, as in LERF-OVS and PT-OVS."""
Figures = Mapping[str, float]
"""Figures of one photo: psnr etc., and `{prefix}{measure}_{category}`."""


def average(photos: Sequence[Figures], with_deviation: bool = False) -> dict[str, Any]:
    """Average every figure over the photos that have it, and add totals.

    `{prefix}map` is the unweighted mean of average precision over the categories. `{prefix}miou`,
    `{prefix}localization_accuracy` etc. are means over all pairs of a photo and a category.
    `ap_{category}_photos` is the number of photos with that category. `with_deviation` adds `…_std` for every
    mean, the sample standard deviation, which is 0 for a single photo.
    """
    values = _by_name(photos)
    means: dict[str, Any] = {name: float(np.mean(found)) for name, found in values.items()}
    totals = _mean_average_precisions(means)
    for prefix, (measure, total) in product(PREFIXES, TOTALS.items()):
        start = f"{prefix}{measure}_"
        pairs = [v for name, found in values.items() if name.startswith(start) for v in found]
        if pairs:
            totals[f"{prefix}{total}"] = float(np.mean(pairs))
    counts = {f"{name}_photos": len(found) for name, found in values.items() if name.startswith("ap_")}
    if with_deviation:
        means |= {f"{n}_std": float(np.std(v, ddof=1)) if len(v) > 1 else 0.0 for n, v in values.items()}
    return means | totals | counts


def _by_name(photos: Iterable[Figures]) -> dict[str, list[float]]:
    values = defaultdict[str, list[float]](list)
    for photo in photos:
        for name, value in photo.items():
            values[name].append(value)
    return values


def _mean_average_precisions(means: Figures) -> dict[str, float]:
    """Compute `{prefix}map`, the unweighted mean of the categories' APs, for each prefix that has some."""
    found = {p: [v for name, v in means.items() if name.startswith(f"{p}ap_")] for p in PREFIXES}
    return {f"{prefix}map": float(np.mean(values)) for prefix, values in found.items() if values}


def pool(scenes: Mapping[str, Sequence[Figures]]) -> dict[str, dict[str, Any]]:
    """Aggregate figures of several scenes in the two ways in which a benchmark's table can be read.

    In `image_pooled`, the `average` over all photos, each photo counts alike, as in the published tables of
    HolyScenes. In `scene_mean`, the mean of the scenes' means, each scene with a category counts alike; its
    `map` is the mean of those over categories. `per_scene` has the `average` of each scene.
    """
    per_scene = {name: average(photos) for name, photos in scenes.items()}
    values = _by_name(per_scene.values())
    means = {name: float(np.mean(v)) for name, v in values.items() if not name.endswith("_photos")}
    means |= _mean_average_precisions(means)
    everything = [photo for photos in scenes.values() for photo in photos]
    return {"image_pooled": average(everything), "scene_mean": means, "per_scene": per_scene}
