"""`lang3dxl benchmark holyscenes|lerf-ovs|pt-ovs`: downloaded scenes, beside the published tables."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import yaml

from lab.benchmarks.ablation import make_all
from lab.benchmarks.ablation_rows import FULL, choose_rows
from lab.benchmarks.kept_runs import KeptRuns
from lab.benchmarks.scored_runs import Run, RunSettings
from lab.reports import command_line
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.common.presets import scene_presets, train_flags
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.evaluation.aggregate import pool
from lang3dxl_ns.evaluation.layouts import is_holyscenes, is_lerf_ovs

_DEPTH = 4
"""Levels of folders below --data that are searched."""
_PHOTOS = ("images", "dense/images")
_NOT_SEARCHED = ("images", "sparse", "dense", "lang3dxl_cache")


@dataclass(frozen=True)
class BenchmarkScene:
    """A scene of a benchmark: photos and labels, which may lie in different folders."""

    name: str
    data: Path
    truth: Path


@showing("data", "out")
@dataclass(kw_only=True)
class _Benchmark:
    data: Path
    """Folder of the downloaded scenes and labels, at most four levels above them."""
    out: Path
    """Folder for the report, and for each scene the run with its scores."""
    scenes: tuple[str, ...] = ()
    """Names of the scenes (default: all that are found)."""
    clip: str = "openai/clip-vit-base-patch32"
    """CLIP: a Hugging Face name, a folder, or "builtin", which knows landmarks and façades alone."""
    foreground: str = "auto"
    """Foreground, as in `lang3dxl prepare`: predictions are 0 elsewhere. auto: masks/, if there is one."""
    iterations: int | None = None
    """Training iterations (default: the published ones, or 30,000)."""
    scale: float = 0.5
    """Size of the training photos relative to those on disk."""
    method: Literal["lang3dxl", "lang3dxl-paper"] = "lang3dxl"
    """The method of `ns-train`: with lang3dxl-paper also the published schedules, and its own SAM."""
    ns_train: str = ""
    """Extra flags of that method in one string, such as "--pipeline.datamanager.regions none"."""

    name: ClassVar[str]
    measures: ClassVar[Mapping[str, str]]
    """Figures of a scene's category, without its name: the column that each gets. The published one first."""

    def main(self) -> None:
        found = {scene.name: scene for scene in self._find()}
        if unknown := sorted(set(self.scenes) - set(found)):
            raise UserError(f"{self.data} has no {', '.join(unknown)}: there are {', '.join(found)}")
        chosen = [found[name] for name in self.scenes] or list(found.values())
        runs = {self._run(scene): self._store(scene) for scene in chosen}
        done: dict[Run, dict[str, Any]] = {}
        failed: dict[Run, str] = {}
        for run, store in runs.items():
            scores, reasons = make_all([run], store, lambda *_: None)
            done |= {one: json.loads((store.kept(one) / "scores.json").read_text()) for one in scores}
            failed |= reasons
            self._write(done, failed)
        print(f"Wrote {self.out / self.name}.md ({len(done)} scenes, {len(failed)} not run)")

    def _run(self, scene: BenchmarkScene) -> Run:
        (row,) = choose_rows((FULL,), True, False)
        row = replace(row, method=self.method)
        steps = self.iterations or int(self._flags(scene).get(_ITERATIONS, "30000"))
        return Run(row, scene.data, scene.name, 0, steps)

    def _store(self, scene: BenchmarkScene) -> KeptRuns:
        flags = {k: v for k, v in self._flags(scene).items() if k != _ITERATIONS}
        if self.method == "lang3dxl":  # its own schedule
            flags = {k: v for k, v in flags.items() if k.startswith("pipeline.datamanager.")}
        words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
        flags_of_all = shlex.join([*words, *shlex.split(self.ns_train)])
        settings = RunSettings(self.clip, "auto", self.foreground, self.scale, flags_of_all)
        return KeptRuns(self.out, settings, scene.truth)

    def _flags(self, scene: BenchmarkScene) -> dict[str, str]:
        """Flags that train the scene as published."""
        return {}

    def _find(self) -> list[BenchmarkScene]:
        """The scenes below `data`. Raises UserError if there is none."""
        root = expanded(self.data).absolute()
        if not root.is_dir():
            raise UserError(f"{root} is not a folder: pass the one that holds the downloaded scenes")
        folders = list(_folders(root, _DEPTH))
        photos = {_plain(f.name): f for f in folders if any((f / images).is_dir() for images in _PHOTOS)}
        truths = {_plain(f.name): f for f in folders if self._is_truth(f)}
        truths |= {key: f / "ground_truth" for key, f in photos.items() if self._is_truth(f / "ground_truth")}
        both = [key for key in truths if key in photos]
        if not both:
            raise UserError(
                f"{root} has no scene with photos (images/ or dense/images/) and labels of the same name: "
                f"found photos of {_named(photos)}, labels of {_named(truths)}"
            )
        return [BenchmarkScene(photos[key].name, photos[key], truths[key]) for key in sorted(both)]

    def _is_truth(self, folder: Path) -> bool:
        return is_lerf_ovs(folder)

    def _write(self, done: Mapping[Run, Mapping[str, Any]], failed: Mapping[Run, str]) -> None:
        known = published_figures(self.name)
        scenes = {run.label: scores["results"] for run, scores in done.items()}
        text = [
            f"# {self.name}",
            f"    {command_line(f'lang3dxl benchmark {self.name}', self)}",
            describe_machine(),
            *(self.tables(scenes, known) if scenes else []),
            "\n".join(f"- {note}" for note in [*known["caveats"], *_protocols(scenes)]),
            *(f"Not run: {run.label}: {reason}" for run, reason in failed.items()),
        ]
        write_report(self.out, self.name, "\n\n".join(text) + "\n", {"scenes": scenes})

    def tables(self, scenes: Mapping[str, Mapping[str, Any]], known: Mapping[str, Any]) -> list[str]:
        """A row per scene and category, ours beside the published figures; then all scenes together."""
        by_scene = {_plain(name): figures for name, figures in known["scenes"].items()}
        rows = {
            (name, category): (results, by_scene.get(_plain(name), {}).get(category, {}))
            for name, results in scenes.items()
            for category in ["all", *_categories(results)]
        }
        pooled = pool({name: list(results["photos"].values()) for name, results in scenes.items()})
        images, total = pooled["image_pooled"], known.get("all", {})
        together = {
            (kind, category): (figures, total.get("mean" if category == "all" else category, {}))
            for kind, figures in (("photos pooled", images), ("mean of scenes", pooled["scene_mean"]))
            for category in ["all", *_categories(images)]
        }
        return ["## Scenes", self._table(rows), "## All scenes", self._table(together)]

    def _table(self, rows: Mapping[tuple[str, str], tuple[Mapping[str, Any], Mapping[str, float]]]) -> str:
        systems = list(dict.fromkeys(system for _, published in rows.values() for system in published))
        lines = []
        for (scene, category), (results, published) in rows.items():
            ours = [_of(results, measure, category) for measure in self.measures]
            count = "" if category == "all" else results.get(f"ap_{category}_photos", "")
            theirs = [published.get(system) for system in systems]
            lines.append([scene, category, count, *map(_figure, [*ours, *theirs])])
        heads = ["", "category", "photos", *self.measures.values(), *(f"{s}, published" for s in systems)]
        return markdown_table(heads, lines)


_MASKS = {
    "authors_ap": "AP as published",
    "ap": "AP, blurred",
    "raw_ap": "AP, unprocessed",
    "teacher_ap": "2-D teacher",
    "limit_ap": "limit",
    "chance_ap": "chance",
}
_LABELS = {
    "located": "localization",
    "smooth_located": "localization, smoothed",
    "smooth_iou": "IoU, smoothed",
    "ap": "AP",
    "teacher_ap": "2-D teacher, AP",
    "chance_ap": "chance, AP",
}
_TOTALS = {
    "located": "localization_accuracy",
    "smooth_located": "smooth_localization_accuracy",
    "smooth_iou": "smooth_miou",
}
_ITERATIONS = "max-num-iterations"


def published_figures(name: str) -> dict[str, Any]:
    """What is published of a benchmark: figures by scene and category, and what limits the comparison."""
    return yaml.safe_load((Path(__file__).parent / "published_figures" / f"{name}.yaml").read_text())


class HolyScenes(_Benchmark):
    """HolyScenes: six landmarks, trained with the published crop ranges and iterations and scored on labeled
    photos that training saw, beside the published figures.

    --data holds the photos of each scene (milano/images and a COLMAP model, or milano/dense/…) and the labels
    (HolyScenes/cathedral/milano/windows/0001-gt.jpg …). Finished scenes are kept, a stopped training goes on.
    """

    name = "holyscenes"
    measures = _MASKS

    def _is_truth(self, folder: Path) -> bool:
        return folder.is_dir() and is_holyscenes(folder)

    def _flags(self, scene: BenchmarkScene) -> dict[str, str]:
        preset = next((p for p in scene_presets() if _plain(p.split("/")[1]) == _plain(scene.name)), None)
        words = [] if preset is None else train_flags(preset)
        return {name.removeprefix("--"): value for name, value in zip(words[::2], words[1::2], strict=True)}


class LerfOvs(_Benchmark):
    """LERF-OVS: scenes of objects with LangSplat's labels, scored on labeled photos that training saw.

    --data holds teatime/images and a COLMAP model, and label/teatime/frame_00002.json. Finished scenes are
    kept, a stopped training goes on.
    """

    name = "lerf-ovs"
    measures = _LABELS

    def _flags(self, scene: BenchmarkScene) -> dict[str, str]:
        return {"pipeline.datamanager.scale-mode": "relative"}


class PtOvs(_Benchmark):
    """PT-OVS: landmarks of Photo Tourism with labels in LangSplat's layout, scored on labeled photos that
    training saw.

    --data holds brandenburg_gate/dense/images, …/dense/sparse and label/brandenburg_gate/PHOTO.json. Finished
    scenes are kept, a stopped training goes on.
    """

    name = "pt-ovs"
    measures = _LABELS


def _folders(root: Path, depth: int) -> Iterator[Path]:
    yield root
    if depth:
        for folder in sorted(root.iterdir()):
            if folder.is_dir() and not folder.name.startswith(".") and folder.name not in _NOT_SEARCHED:
                yield from _folders(folder, depth - 1)


def _plain(name: str) -> str:
    """A scene's name as it is compared: letters and digits alone."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _named(folders: Mapping[str, Path]) -> str:
    return ", ".join(sorted(folder.name for folder in folders.values())) or "none"


def _categories(results: Mapping[str, Any]) -> list[str]:
    return [
        name.removeprefix("ap_").removesuffix("_photos")
        for name in results
        if name.startswith("ap_") and name.endswith("_photos")
    ]


def _of(results: Mapping[str, Any], measure: str, category: str) -> float | None:
    if category != "all":
        return results.get(f"{measure}_{category}")
    return results.get(_TOTALS.get(measure, f"{measure.removesuffix('ap')}map"))


def _protocols(scenes: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [
        f"{name}: {p['evaluated_photos']} labeled photos, {p['seen_in_training']} of them seen in training; "
        f"foreground: {p['foreground']}"
        for name, p in ((name, results["protocol"]) for name, results in scenes.items())
    ]


def _figure(value: float | None) -> str | None:
    return None if value is None else f"{value:.3f}"
