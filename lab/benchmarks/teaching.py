"""`lang3dxl benchmark teaching`: words taught by example, scored in photos that are not marked."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from lab.reports import command_line
from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.scores import average_precision, overlap
from lang3dxl_ns.words.taught_words import Box, Example, Point

if TYPE_CHECKING:
    from lang3dxl_ns.query.scene import Scene

_LEAST_AREA = 0.003
"""Share of a photo that a word must cover for the photo to be marked."""
Masks = Mapping[str, Bool[Array, "h w"]]
"""Of a word, by the scene's names of the photos."""


@showing("scene", "out", "ground_truth")
@dataclass(kw_only=True)
class TeachingBenchmark:
    """Teach every labeled word by clicks, boxes and outlines drawn from its labels, and score its maps in the
    labeled photos that are not marked, beside the text alone."""

    scene: tyro.conf.Positional[Path | None] = None
    """A .scene file, or a folder that holds one (default: the newest run under outputs/)."""
    ground_truth: Path
    """Folder of the scene's labels, in any layout of docs/evaluation.md."""
    out: Path
    """Folder for teaching.md and teaching.json."""
    mark: str | None = None
    """Photo to mark (default: for each word the one that shows most of it)."""
    photos: int = 3
    """Photos marked in the rows of several photos."""
    draws: int = 2
    """Random draws of clicks."""
    size: int = 320
    """Longer side of the scored maps, pixels."""

    def main(self) -> None:
        """Measure and write the report."""
        from lang3dxl_ns.open_scene import load_scene

        scene = load_scene(self.scene).with_words(())
        truth = GroundTruth(self.ground_truth)
        figures: dict[str, dict[str, dict[str, float]]] = {}
        for word in tracked(truth.categories, "teaching"):
            if found := self._word(scene, truth, word):
                figures[word] = found
        figures_of_time = {"teach_seconds": seconds_of_a_click(scene)}
        command = command_line("lang3dxl benchmark teaching", self)
        text = report(figures, command, describe_machine(scene.device), figures_of_time["teach_seconds"])
        write_report(self.out, "teaching", text, figures_of_time | {"words": figures})
        print(f"Wrote {self.out / 'teaching.md'}")

    def _word(self, scene: Scene, truth: GroundTruth, word: str) -> dict[str, dict[str, float]]:
        masks = self._masks(scene, truth, word)
        large = [name for name in masks if masks[name].mean() >= _LEAST_AREA]
        large.sort(key=lambda name: -masks[name].mean())
        if self.mark is not None:
            first = scene.file.photo(self.mark).name
            large = [first, *(name for name in large if name != first)] if first in large else []
        if not large or len(masks) < 2:
            return {}
        several = large[: min(self.photos, len(masks) - 1)]
        rows = {"text": scene.ask(word).relevancy[0]}
        scored = {"text": large[:1]}
        for name, make in ways(self.draws).items():
            for marked in {1: large[:1], len(several): several}.values():
                row = f"{name}, {len(marked)} photo{'s' if len(marked) > 1 else ''}"
                examples = [make(photo, masks[photo], self._size(scene, photo)) for photo in marked]
                rows[row] = scene.teach(word, examples).ask(word).relevancy[0]
                scored[row] = marked
        return self._scores(scene, masks, rows, scored)

    def _masks(self, scene: Scene, truth: GroundTruth, word: str) -> Masks:
        masks = {}
        for photo in scene.photos:
            key = truth.key(photo.name)
            if key is not None and key in truth.photos(word):
                camera = scene.camera(photo.name, self.size)
                mask = truth.truths(key, (camera.height, camera.width))[word].mask
                foreground = photo.foreground((camera.height, camera.width))
                mask = mask if foreground is None else mask & foreground.numpy()
                if mask.any():
                    masks[photo.name] = mask
        return masks

    def _size(self, scene: Scene, photo: str) -> tuple[int, int]:
        found = scene.file.photo(photo)
        return found.size or (found.lens.width, found.lens.height)

    def _scores(
        self,
        scene: Scene,
        masks: Masks,
        rows: Mapping[str, Float[Tensor, " n"]],
        marked: Mapping[str, Sequence[str]],
    ) -> dict[str, dict[str, float]]:
        """Mean average precision and IoU of each row over the photos that it doesn't mark."""
        channels = torch.stack(list(rows.values()), 1).contiguous()
        found: dict[str, list[tuple[float, float]]] = {row: [] for row in rows}
        for photo, mask in masks.items():
            drawn = scene.draw(scene.camera(photo, self.size), channels).channels
            assert drawn is not None
            foreground = scene.file.photo(photo).foreground((mask.shape[0], mask.shape[1]))
            for row, one in zip(rows, drawn.permute(2, 0, 1).cpu().numpy(), strict=True):
                if photo not in marked[row]:
                    shown = one if foreground is None else one * foreground.numpy()
                    precision = average_precision(shown, mask)
                    assert precision is not None
                    found[row].append((precision, overlap(shown > 0.5, mask)["iou"]))
        means = {row: np.mean(values, 0).tolist() for row, values in found.items() if values}
        return {row: {"ap": ap, "iou": iou} for row, (ap, iou) in means.items()}


Draw = Callable[[str, Bool[Array, "h w"], tuple[int, int]], Example]
"""Makes an example from a photo's name, its mask, and the width and height of its file."""


def ways(draws: int) -> dict[str, Draw]:
    """The ways to mark a photo, by name; random clicks in several draws."""
    found: dict[str, Draw] = {}
    for count in (1, 3, 10):
        for draw in range(draws):
            found[f"{count} click{'s' if count > 1 else ''} #{draw + 1}"] = _clicks(count, draw)
    return found | {"1 click at the edge": _edge_click, "box": _box, "outline": _outline}


def _clicks(count: int, draw: int) -> Draw:
    def make(photo: str, mask: Bool[Array, "h w"], size: tuple[int, int]) -> Example:
        inside = np.argwhere(mask)
        chosen = np.random.default_rng(draw).choice(len(inside), min(count, len(inside)), replace=False)
        return Example(photo, points=tuple(_point(inside[i], mask, size) for i in chosen))

    return make


def _edge_click(photo: str, mask: Bool[Array, "h w"], size: tuple[int, int]) -> Example:
    """The worst place for a click: as close to the edge as can be."""
    depth = np.where(mask, distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1], np.inf)
    place = np.argwhere(depth == depth.min())[0]
    return Example(photo, points=(_point(place, mask, size),))


def _box(photo: str, mask: Bool[Array, "h w"], size: tuple[int, int]) -> Example:
    rows, columns = mask.any(1).nonzero()[0], mask.any(0).nonzero()[0]
    x, y = size[0] / mask.shape[1], size[1] / mask.shape[0]
    box: Box = (
        *(float(columns[0] * x), float(rows[0] * y)),
        *(float((columns[-1] + 1) * x), float((rows[-1] + 1) * y)),
    )
    return Example(photo, box=box)


def _outline(photo: str, mask: Bool[Array, "h w"], size: tuple[int, int]) -> Example:
    return Example(photo, mask)


def _point(place: Int[Array, "2"], mask: Bool[Array, "h w"], size: tuple[int, int]) -> Point:
    row, column = (int(x) for x in place)
    return (column + 0.5) * size[0] / mask.shape[1] - 0.5, (row + 0.5) * size[1] / mask.shape[0] - 0.5


def seconds_of_a_click(scene: Scene, repeats: int = 5) -> float:
    """Median seconds from a click in the middle of the overview to the relevancy of every Gaussian; processor
    time without a GPU."""
    clock = time.perf_counter if scene.device.type == "cuda" else time.process_time
    width, height = scene.overview.size or (scene.overview.lens.width, scene.overview.lens.height)
    example = Example(scene.overview.name, points=((width / 2, height / 2),))

    def once() -> float:
        start = clock()
        scene.teach("this", example).ask("this").relevancy.sum().item()
        return clock() - start

    once()
    return median(once() for _ in range(repeats))


def report(
    figures: Mapping[str, Mapping[str, Mapping[str, float]]], command: str, machine: str, seconds: float
) -> str:
    """The report in markdown: average precision / IoU, random clicks averaged over their draws."""
    words = list(figures)
    rows = list(dict.fromkeys(_kind(row) for found in figures.values() for row in found))
    lines = []
    for kind in rows:
        means = {
            word: np.mean([list(v.values()) for row, v in found.items() if _kind(row) == kind], 0)
            for word, found in figures.items()
            if any(_kind(row) == kind for row in found)
        }
        cells = [_cell(means.get(word)) for word in words]
        lines.append([kind, _cell(np.mean(list(means.values()), 0)), *cells])
    return f"""# Words taught by example

    {command}

{machine}. Average precision / IoU at 0.5 in the labeled photos that are not marked; clicks are means of
random draws inside the label. A click takes {1e3 * seconds:.0f} ms.

{markdown_table(("marked", "mean", *words), lines)}
"""


def _kind(row: str) -> str:
    name, _, photos = row.partition(", ")
    return ", ".join(filter(None, [name.partition(" #")[0], photos]))


def _cell(values: Float[Array, "2"] | None) -> str | None:
    return None if values is None else f"{values[0]:.3f} / {values[1]:.2f}"
