"""`lang3dxl benchmark best-views`: whether the views that queries choose show what was asked for."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
import tyro
from jaxtyping import Bool
from numpy import ndarray as Array

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import command_line, describe_machine, markdown_table, write_report
from lang3dxl_ns.demo.landmark.labels import CATEGORIES, SMALLEST_POSITIVE, category_masks
from lang3dxl_ns.demo.landmark.landmark import Landmark
from lang3dxl_ns.demo.landmark.photography import take_photo
from lang3dxl_ns.demo.landmark.scene_writer import photo_view

ROSE = "rose window"
WORDS = (*CATEGORIES, ROSE)
_SIDE = 160
"""Pixels of the longer side that labels are drawn at."""
_TOP = 3


@dataclass
class BestViews:
    """Rank the training photos of demo runs for each word, and compare with the photos' exact labels.

    A view *contains* a word if its pixels fill a thousandth of it. It is *good* if they fill at least the
    median of the photos that contain it, and some lie in the middle half of the picture.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `lang3dxl demo --out` wrote."""
    out: Path
    """Folder for best_views.md and best_views.json."""

    def main(self) -> None:
        from lang3dxl_ns.plugin.load_scene import load_scene

        rows: dict[str, dict[str, list[float]]] = {}
        for run in self.runs:
            scene = load_scene(run)
            truth = true_masks(run / "scene", list(scene.visible))
            for word in WORDS:
                shown = {name: masks[word] for name, masks in truth.items()}
                if not any(map(contains, shown.values())):
                    continue
                ranked = [v.name for v in scene.find(word, most=_TOP)[0].closest]
                rows.setdefault(word, {"best": [], "top": [], "any": []})
                rows[word]["best"].append(float(contains(shown[ranked[0]])))
                good = good_views(shown)
                rows[word]["top"] += [float(name in good) for name in ranked[:_TOP]]
                rows[word]["any"].append(len(good) / len(shown))
        if not rows:
            raise UserError("there is no run: name the folders of lang3dxl demo --out")
        table = [[word, len(r["best"]), *(f"{np.mean(r[k]):.2f}" for k in r)] for word, r in rows.items()]
        pooled = {k: np.concatenate([r[k] for r in rows.values()]) for k in ("best", "top", "any")}
        table.append(["**all**", len(pooled["best"]), *(f"**{v.mean():.2f}**" for v in pooled.values())])
        heads = ["word", "landmarks", "best view contains it", f"good of the top {_TOP}", "good of all views"]
        text = f"{command_line('lang3dxl benchmark best-views', self)}\n\n{markdown_table(heads, table)}"
        report = {"machine": describe_machine(), "words": rows}
        write_report(self.out, "best_views", text, report)
        print(text)


def true_masks(scene: Path, photos: Sequence[str]) -> dict[str, dict[str, Bool[Array, "h w"]]]:
    """Masks of every word in photos of a generated scene, drawn anew from its seed."""
    made = json.loads((scene / "scene.json").read_text())
    landmark = Landmark.from_seed(made["seed"], made["family"])
    roses = [replace(s, element=0) if getattr(s, "filling", "rose") != "rose" else s for s in landmark.shapes]
    only_roses = replace(landmark, shapes=tuple(roses))
    found = {}
    for name in photos:
        number = int(PurePosixPath(name).stem)
        view, width, height = photo_view(landmark, made["seed"], number, made["wild"], _size(made))
        scale = _SIDE / max(width, height)
        size = round(width * scale), round(height * scale)
        labels, rose = take_photo(landmark, view, *size), take_photo(only_roses, view, *size)
        found[name] = category_masks(labels.parts, labels.elements)
        found[name][ROSE] = category_masks(rose.parts, rose.elements)["windows"]
    return found


def _size(made: Mapping[str, int]) -> tuple[int, int]:
    return made.get("width", 480), made.get("height", 360)


def contains(mask: Bool[Array, "h w"]) -> bool:
    """Whether a picture shows something at all."""
    return bool(mask.mean() >= SMALLEST_POSITIVE)


def good_views(shown: Mapping[str, Bool[Array, "h w"]]) -> set[str]:
    """Names of the pictures that a person would choose; see `BestViews`."""
    sizes = {name: float(mask.mean()) for name, mask in shown.items() if contains(mask)}
    median = float(np.median(list(sizes.values())))
    return {name for name, size in sizes.items() if size >= median and _in_the_middle(shown[name])}


def _in_the_middle(mask: Bool[Array, "h w"]) -> bool:
    height, width = mask.shape
    return bool(mask[height // 4 : height - height // 4, width // 4 : width - width // 4].any())
