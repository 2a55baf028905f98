"""Reports of evaluations: writing their tables in markdown, and reading them again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lang3dxl_ns.common.checks import expect, is_coordinate
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.common.reports import markdown_table
from lang3dxl_ns.evaluation.aggregate import PREFIXES, TOTALS

_SELECTIONS = {"mask_iou": "masks", "selection_iou": "selected Gaussians", "box_iou": "boxes"}
"""Figures of `evaluation.selections`, and their names in reports."""
_OTHERS = (
    *("half_psnr", "half_ssim", "half_lpips", "psnr", "cc_psnr", "ssim", "lpips"),
    *(f"{name}{of}" for name in ("clip_l1", "clip_psnr", "clip_cosine") for of in ("", "_of_mean")),
    *(f"{name}{of}" for name in ("dense_l1", "dense_cosine") for of in ("", "_of_mean")),
    *("render_seconds", "query_seconds", "fit_seconds", "peak_memory_mb"),
)


def read_results(path: Path) -> tuple[str, dict[str, Any]]:
    """Read scene and results of a report, also one in the form of `ns-eval`. Raises UserError for another
    file, and for figures that are not numbers."""
    try:
        content = read_json(path)
        results = content["results"]
        for figures in results["photos"].values():
            expect(all(map(is_coordinate, figures.values())), "a photo has a figure that is not a number")
        expect(isinstance(results["protocol"], dict), "it does not say what was scored")
        return str(content.get("scene") or content["experiment_name"]), results
    except FileNotFoundError as error:
        raise UserError(f"there is no {path}: name the scores.json of a report") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} is not a report of `lang3dxl evaluate` or `ns-eval` ({error!r}): make it again"
        ) from error


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
    counts = (name for name in results if name.startswith("ap_") and name.endswith("_photos"))
    return [name.removeprefix("ap_").removesuffix("_photos") for name in counts]
