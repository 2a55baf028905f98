"""Aggregation of scores, from photos to scene and from scenes to benchmark, and the tables of reports."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from lang3dxl_ns.common.checks import expect, is_coordinate
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.common.reports import markdown_table

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
_SELECTIONS = {"mask_iou": "masks", "selection_iou": "selected Gaussians", "box_iou": "boxes"}
"""Figures of `evaluation.score_scene`, and their names in reports."""
_OTHERS = (
    *("half_psnr", "half_ssim", "half_lpips", "psnr", "cc_psnr", "ssim", "lpips"),
    *(f"{name}{of}" for name in ("clip_l1", "clip_psnr", "clip_cosine") for of in ("", "_of_mean")),
    *(f"{name}{of}" for name in ("dense_l1", "dense_cosine") for of in ("", "_of_mean")),
    *("render_seconds", "query_seconds", "fit_seconds", "peak_memory_mb"),
)
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
    """Aggregate figures of several scenes in the two ways in which a benchmark's table can be read. In
    `image_pooled`, the `average` over all photos, each photo counts alike, as in the published tables of
    HolyScenes. In `scene_mean`, the mean of the scenes' means, each scene with a category counts alike; its
    `map` is the mean of those over categories. `per_scene` has the `average` of each scene."""
    per_scene = {name: average(photos) for name, photos in scenes.items()}
    values = _by_name(per_scene.values())
    counts = {f"{name}_photos" for name in values}
    means = {name: float(np.mean(v)) for name, v in values.items() if name not in counts}
    means |= _mean_average_precisions(means)
    everything = [photo for photos in scenes.values() for photo in photos]
    return {"image_pooled": average(everything), "scene_mean": means, "per_scene": per_scene}


# ── reports ─────────────────────────────────────────────────────────────────────────────────────────────


def read_results(path: Path) -> tuple[str, dict[str, Any]]:
    """Read scene and results of a report, also one in the form of `ns-eval`. Raises UserError for another
    file, and for figures that are not numbers."""
    if not path.exists():
        raise UserError(f"there is no {path}: name the scores.json of a report")
    with readable(f"{path} is not a report of `lang3dxl evaluate` or `ns-eval`", "make it again"):
        content = read_json(path)
        results = content["results"]
        for figures in results["photos"].values():
            expect(all(map(is_coordinate, figures.values())), "a photo has a figure that is not a number")
        expect(isinstance(results["protocol"], dict), "it does not say what was scored")
        json.dumps(results["protocol"], allow_nan=False)  # raises ValueError for what can't be written
        return str(content.get("scene") or content["experiment_name"]), results


def scene_table(scene: str, results: Mapping[str, Any]) -> str:
    """Write the report in markdown: average precision by category, then totals, then the protocol."""

    def figure(name: str) -> str:
        deviation = results.get(f"{name}_std")
        return f"{results[name]:.3f}" + ("" if deviation is None else f" ± {deviation:.3f}")

    whose = [prefix for prefix in PREFIXES if f"{prefix}map" in results]
    heads = PREFIXES | ({"": "unprocessed"} if results["protocol"].get("layout") == "lerf_ovs" else {})
    categories = sorted(_categories(results))
    rows = [
        [c, results[f"ap_{c}_photos"], *(figure(f"{prefix}ap_{c}") for prefix in whose)] for c in categories
    ]
    rows.append(["**mAP**", "", *(f"**{results[f'{prefix}map']:.3f}**" for prefix in whose)])
    words = markdown_table(["average precision", "photos", *(heads[prefix] for prefix in whose)], rows)
    selected = [c for c in categories if f"mask_iou_{c}" in results]
    if selected:
        figures = {c: [results[f"{name}_{c}"] for name in _SELECTIONS] for c in selected}
        rows = [[c, *(f"{value:.3f}" for value in values)] for c, values in figures.items()]
        columns = zip(*figures.values(), strict=True)
        rows.append(["**mean**", *(f"**{sum(column) / len(column):.3f}**" for column in columns)])
        words += "\n\n" + markdown_table(["IoU by the scene's thresholds", *_SELECTIONS.values()], rows)
    totals = [[name, f"{results[name]:.3f}"] for name in TOTALS.values() if name in results]
    others = [[name, figure(name)] for name in _OTHERS if name in results]
    protocol = "\n".join(f"- {name.replace('_', ' ')}: {v}" for name, v in results["protocol"].items())
    overall = markdown_table(["", "mean"], totals + others)
    return f"# {scene}\n\n{words if categories else ''}\n\n{overall}\n\n{protocol}\n"


def pooled_table(pooled: Mapping[str, Mapping[str, Any]]) -> str:
    """Write the table of `aggregate.pool`: average precision of several scenes, by category."""
    images, scenes, each = pooled["image_pooled"], pooled["scene_mean"], pooled["per_scene"]

    def row(name: str) -> list[str | None]:
        found = [figures.get(name) for figures in (images, scenes, *each.values())]
        return [None if value is None else f"{value:.3f}" for value in found]

    rows = [[c, images[f"ap_{c}_photos"], *row(f"ap_{c}")] for c in _categories(images)]
    pooled_map, scene_map, *by_scene = row("map")
    rows.append(["**mAP**", "", f"**{pooled_map}**", f"**{scene_map}**", *by_scene])
    return markdown_table(["average precision", "photos", "image-pooled", "scene mean", *each], rows)


def _categories(results: Mapping[str, Any]) -> list[str]:
    """List the categories: each has a figure and a count, and its name may end as a count's does."""
    named = (name.removesuffix("_photos") for name in results if name.endswith("_photos"))
    return [name.removeprefix("ap_") for name in named if name.startswith("ap_") and name in results]
