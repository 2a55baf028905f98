"""Reports of evaluations: their tables in markdown, and reading them again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lang3dxl_ns.common.checks import is_coordinate
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.common.reports import markdown_table
from lang3dxl_ns.evaluation.aggregate import PREFIXES, TOTALS, mean_average_precision

WHOSE = {
    "": "blurred",
    "raw_": "unprocessed",
    "authors_": "as published",
    "teacher_": "2-D teacher",
    "limit_": "limit",
    "chance_": "chance",
}
"""Column headers of the report."""


def read_results(path: Path) -> tuple[str, dict[str, Any]]:
    """Scene and results of a report, also in the form of `ns-eval`.

    Raises UserError for another file, and for figures that are not numbers.
    """
    try:
        content = read_json(path)
        results = content["results"]
        for figures in results["photos"].values():
            if not all(map(is_coordinate, figures.values())):
                raise ValueError("a photo has a figure that is not a number")
        if not isinstance(results["protocol"], dict):
            raise ValueError("it does not say what was scored")
        return str(content.get("scene") or content["experiment_name"]), results
    except FileNotFoundError as error:
        raise UserError(f"there is no {path}: name the scores.json of a report") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} is not a report of `lang3dxl evaluate` or `ns-eval` ({error!r}): make it again"
        ) from error


def scene_table(scene: str, results: Mapping[str, Any]) -> str:
    """The report in markdown: average precision by category, then totals, then the protocol."""
    categories = sorted(name.removeprefix("ap_").removesuffix("_photos") for name in results if _counts(name))
    whose = [prefix for prefix in PREFIXES if f"{prefix}map" in results]
    rows = [
        [c, results[f"ap_{c}_photos"], *(_mean_std(results, f"{prefix}ap_{c}") for prefix in whose)]
        for c in categories
    ]
    rows.append(["**mAP**", "", *(f"**{results[f'{prefix}map']:.3f}**" for prefix in whose)])
    heads = WHOSE | ({"": "unprocessed"} if results["protocol"].get("layout") == "lerf_ovs" else {})
    words = markdown_table(["average precision", "photos", *(heads[prefix] for prefix in whose)], rows)
    if any(f"mask_iou_{c}" in results for c in categories):
        words += "\n\n" + selection_table(results, categories)
    totals = [[name, f"{results[name]:.3f}"] for name in TOTALS.values() if name in results]
    others = [[name, _mean_std(results, name)] for name in _OTHERS if name in results]
    protocol = "\n".join(f"- {name.replace('_', ' ')}: {v}" for name, v in results["protocol"].items())
    figures = markdown_table(["", "mean"], totals + others)
    return f"# {scene}\n\n{words if categories else ''}\n\n{figures}\n\n{protocol}\n"


def selection_table(results: Mapping[str, Any], categories: Sequence[str]) -> str:
    """IoU of what a user gets (`evaluation.selections`), by category."""
    names = ("mask_iou", "selection_iou", "box_iou")
    figures = {
        c: [results[f"{name}_{c}"] for name in names] for c in categories if f"mask_iou_{c}" in results
    }
    rows = [[c, *(f"{value:.3f}" for value in values)] for c, values in figures.items()]
    means = [sum(column) / len(column) for column in zip(*figures.values(), strict=True)]
    rows.append(["**mean**", *(f"**{mean:.3f}**" for mean in means)])
    return markdown_table(["IoU by the scene's thresholds", "masks", "selected Gaussians", "boxes"], rows)


_OTHERS = (
    "half_psnr",
    "half_ssim",
    "half_lpips",
    "psnr",
    "cc_psnr",
    "ssim",
    "lpips",
    *(f"{name}{of}" for name in ("clip_l1", "clip_psnr", "clip_cosine") for of in ("", "_of_mean")),
    *(f"{name}{of}" for name in ("dense_l1", "dense_cosine") for of in ("", "_of_mean")),
    "render_seconds",
    "query_seconds",
    "fit_seconds",
    "peak_memory_mb",
)


def _counts(name: str) -> bool:
    return name.startswith("ap_") and name.endswith("_photos")


def _mean_std(results: Mapping[str, Any], name: str) -> str:
    deviation = results.get(f"{name}_std")
    return f"{results[name]:.3f}" + ("" if deviation is None else f" ± {deviation:.3f}")


def pooled_table(pooled: Mapping[str, Mapping[str, Any]]) -> str:
    images, scenes, each = pooled["image_pooled"], pooled["scene_mean"], pooled["per_scene"]
    categories = [name for name in images if name.startswith("ap_") and f"{name}_photos" in images]
    rows = [
        [
            name.removeprefix("ap_"),
            images[f"{name}_photos"],
            f"{images[name]:.3f}",
            f"{scenes[name]:.3f}",
            *(f"{figures[name]:.3f}" if name in figures else None for figures in each.values()),
        ]
        for name in categories
    ]
    by_scene = [mean_average_precision(figures) for figures in each.values()]
    rows.append(
        ["**mAP**", "", f"**{images['map']:.3f}**", f"**{scenes['map']:.3f}**"]
        + [None if value is None else f"{value:.3f}" for value in by_scene]
    )
    return markdown_table(["average precision", "photos", "image-pooled", "scene mean", *each], rows)
