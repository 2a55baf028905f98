"""`lang3dxl benchmark things`: instances, counts and boxes against what the generator built.

Boxes are compared with the building's own, and, as `lang3dxl evaluate run` does, with those of the Gaussians
that photos show on each true thing: what lies between the two is the depth of the trained geometry.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.optimize import linear_sum_assignment

from lab.benchmarks.questions import Known, Outcome, ask_all, in_words
from lab.landmark.instances import CLEAR, TrueThing, photos_of, pixels, placed, seen_things, true_things
from lab.landmark.labels import CATEGORIES
from lab.landmark.landmark import Landmark
from lab.reports import command_line
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.common.reports import markdown_table, write_report
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.rendering import composite
from lang3dxl_ns.rendering.gathering import Pixels, gather
from lang3dxl_ns.things.find import Things, axes_of
from lang3dxl_ns.things.thing import Thing, upright_box
from lang3dxl_ns.things.write import coco

NEAR = 0.6
"""A thing is found if a center is this close to its own, relative to its longest edge."""
_SAMPLES = 20
"""Points per axis in which two boxes are compared."""


@dataclass
class ThingsBenchmark:
    """Score the things of trained demo scenes: F1, counts, 3-D IoU of boxes, time, and 200 questions."""

    scene: tuple[Path, ...]
    """Scene files or runs of demo scenes, as `lang3dxl query` takes them."""
    data: tuple[Path, ...]
    """Folder of each scene's photos, which holds its scene.json."""
    out: Path
    """Folder for things.md and things.json."""

    def main(self) -> None:
        from lang3dxl_ns.open_scene import load_scene

        if len(self.scene) != len(self.data):
            raise UserError("give as many --data folders as scenes")
        rows: list[Score] = []
        asked: list[Outcome] = []
        seconds: dict[str, float] = {}
        labels: list[tuple[int, int, float | None]] = []
        for path, data in zip(self.scene, self.data, strict=True):
            scene, truth = load_scene(path), true_things_of(load_scene(path), data)
            scene.mass  # noqa: B018 — measured once per scene, at the first query
            start = time.process_time()
            answers = scene.things(list(CATEGORIES))
            seconds[data.parent.name] = time.process_time() - start
            marks = marked_boxes(scene, data)
            rows += [score(answer, truth, data.parent.name, marks) for answer in answers]
            labels += labels_of(scene, data, answers, truth)
            asked += ask_all(scene, {one.word: known(one, truth) for one in answers})
        table = markdown_table(
            [
                "word",
                "seen",
                "found",
                "false",
                "F1",
                "count off (median)",
                "in range",
                "box IoU",
                "of Gaussians",
            ],
            [_summary(word, [row for row in rows if row.word == word]) for word in CATEGORIES],
        )
        times = ", ".join(f"{name} {t:.1f}" for name, t in seconds.items())
        command = command_line("lang3dxl benchmark things", self)
        text = f"# Things\n\n    {command}\n\n{table}\n\nProcessor seconds per catalog: {times}\n"
        text += f"\n{labels_in_words(labels)}\n\n{in_words(asked)}\n"
        each = [vars(row) for row in rows]
        write_report(
            self.out,
            "things",
            text,
            {"scores": each, "seconds": seconds, "questions": [vars(o) for o in asked]},
        )
        print(text)


@dataclass(frozen=True)
class Score:
    """Score of one word in one scene."""

    scene: str
    word: str
    seen: int
    """True things that the photos show."""
    found: int
    false: int
    """Things found where there are none. Those at true things that the photos hardly show don't count."""
    count: tuple[int, int, int]
    """Count, and the range that it is said to lie in."""
    ious: tuple[float, ...]
    """Of the boxes of the things found, against the building's."""
    marked_ious: tuple[float, ...] = ()
    """The same, against boxes of the Gaussians that photos show on the true things."""

    @property
    def off(self) -> float:
        """Relative error of the count."""
        return abs(self.count[0] - self.seen) / max(self.seen, 1)


def true_things_of(scene: Scene, data: Path) -> list[TrueThing]:
    """Return the true things in the scene's frame."""
    matrix, scale = np.array(scene.file.transform), scene.file.scale
    stretch = np.cbrt(np.linalg.det(matrix[:, :3]))
    frame = scale * stretch, matrix[:, :3] / stretch, scale * matrix[:, 3]
    return [placed(thing, *frame, thing.pixels) for thing in seen_things(data)]


def marked_boxes(scene: Scene, data: Path) -> list[Thing | None]:
    """Return the box of each true thing's Gaussians: those of whose pixels in the training photos more than
    half show it. None for a thing with fewer than two."""
    about = read_json(data / "scene.json")
    landmark = Landmark.from_seed(about["seed"], about["family"])
    things, numbers = true_things(landmark)

    def probes():
        for name, camera, _ in photos_of(about):
            if name in scene.visible:
                own = scene.file.photo(name).camera
                shown = torch.from_numpy(pixels(landmark, numbers, camera, (own.width, own.height)))
                labels = F.one_hot(shown + 1, len(things) + 1)[:, :, 1:].float()
                yield partial(composite, scene.splats, own), Pixels.of([labels], shown.shape)

    shares, mass = gather(len(scene.splats), probes(), len(things), scene.splats.means)
    means, axes = scene.splats.means.double().cpu().numpy(), axes_of(scene)
    marked = [np.flatnonzero(share > 0.5) for share in shares.T.cpu().numpy()]
    weight = mass.double().cpu().numpy()
    return [_boxed(rows, means, weight, axes) if len(rows) > 1 else None for rows in marked]


def _boxed(
    rows: Int[Array, " m"], means: Float[Array, "n 3"], mass: Float[Array, " n"], axes: Float[Array, "3 3"]
) -> Thing:
    return Thing(0, "", 1.0, 0, *upright_box(means[rows], mass[rows], axes), rows)


def score(
    answer: Things, truth: Sequence[TrueThing], scene: str = "", marks: Sequence[Thing | None] = ()
) -> Score:
    """Compare the answer to one word with the true things of that word, each matched once. `marks` are the
    `marked_boxes` of the true things."""
    own = [thing for thing in truth if thing.word == answer.word]
    seen, hidden = ([t for t in own if t.seen is shown] for shown in (True, False))
    pairs = matched(answer.things, seen)
    free = [t for i, t in enumerate(answer.things) if i not in {a for a, _ in pairs}]
    false = len(free) - len(matched(free, hidden))
    ious = tuple(box_iou(answer.things[a], seen[b]) for a, b in pairs)
    count = len(answer.things), answer.least, answer.most
    boxes = dict(zip(truth, marks, strict=False))
    marked = ((answer.things[a], boxes.get(seen[b])) for a, b in pairs)
    marked_ious = tuple(box_iou(found, box) for found, box in marked if box is not None)
    return Score(scene, answer.word, len(seen), len(pairs), false, count, ious, marked_ious)


def labels_of(
    scene: Scene, data: Path, answers: Sequence[Things], truth: Sequence[TrueThing]
) -> list[tuple[int, int, float | None]]:
    """Compare the COCO labels of the things found with the true ones' pixels: for each of them and each
    training photo the number of pixels that show it, of those that its label has, and their boxes' IoU."""
    about, content = read_json(data / "scene.json"), coco(scene, answers)
    landmark = Landmark.from_seed(about["seed"], about["family"])
    _, numbers = true_things(landmark)
    images = {image["file_name"]: image["id"] for image in content["images"]}
    labels = {(one["image_id"], one["thing"]): one for one in content["annotations"]}
    own = [(one, [t for t in truth if t.word == one.word and t.seen]) for one in answers]
    pairs = [
        (one.things[a].id, truth.index(seen[b])) for one, seen in own for a, b in matched(one.things, seen)
    ]
    found: list[tuple[int, int, float | None]] = []
    for name, camera, _ in photos_of(about):
        if name in scene.visible:
            shown = pixels(landmark, numbers, camera, scene.file.photo(name).file_size)
            for thing, number in pairs:
                label, (rows, columns) = labels.get((images[name], thing)), (shown == number).nonzero()
                iou = None
                if label and len(rows):
                    true = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
                    iou = _overlap(label["bbox"], true)
                found.append((len(rows), label["area"] if label else 0, iou))
    return found


def _overlap(box: Sequence[float], other: Sequence[float]) -> float:
    """Intersection over union of a COCO box and of another's ends."""
    (x, y, wide, high), (left, top, right, bottom) = box, other
    shared = max(min(x + wide, right) - max(x, left), 0) * max(min(y + high, bottom) - max(y, top), 0)
    return shared / (wide * high + (right - left) * (bottom - top) - shared)


def labels_in_words(labels: Sequence[tuple[int, int, float | None]]) -> str:
    """Tell how many of the things that photos clearly show have a label there, and how good that is."""
    clear = [(area, iou) for pixels, area, iou in labels if pixels >= CLEAR]
    labeled, false = sum(area > 0 for area, _ in clear), sum(area > 0 for n, area, _ in labels if not n)
    iou = np.mean([iou for _, iou in clear if iou is not None] or [0])
    told = f"Of {len(clear)} views of things found, {labeled} have a label (IoU of boxes {iou:.2f})"
    return f"{told}; {false} labels are of things that the photo does not show."


def known(answer: Things, truth: Sequence[TrueThing]) -> Known:
    """Tell which things found are which true ones, for questions."""
    own = [thing for thing in truth if thing.word == answer.word]
    seen, hidden = ([t for t in own if t.seen is shown] for shown in (True, False))
    # An id of its own each, over all words: a thing has no relation to itself.
    true = [Thing(-1 - truth.index(t), t.word, 1.0, 0, t.center, t.axes, t.size, np.zeros(0, int))
            for t in seen]  # fmt: skip
    matches: dict[Thing, Thing | None] = {answer.things[a]: true[b] for a, b in matched(answer.things, seen)}
    free = [thing for thing in answer.things if thing not in matches]
    return Known(answer, true, matches | {free[a]: None for a, _ in matched(free, hidden)})


def matched(things: Sequence[Thing], truth: Sequence[TrueThing]) -> list[tuple[int, int]]:
    """Match things with true ones so that as many as possible are found; return pairs of indices."""
    if not things or not truth:
        return []
    centers, places = np.array([t.center for t in things]), np.array([t.center for t in truth])
    size = np.array([t.size.max() for t in truth])
    apart = np.linalg.norm(centers[:, None] - places, axis=2) / size
    pairs = zip(*linear_sum_assignment(np.where(apart < NEAR, apart - 10, 0.0)), strict=True)
    return [(int(a), int(b)) for a, b in pairs if apart[a, b] < NEAR]


def box_iou(a: Thing | TrueThing, b: Thing | TrueThing) -> float:
    """Estimate intersection over union of two oriented boxes, by points in the first."""
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    points = (grid * a.size) @ a.axes + a.center
    inside = (abs((points - b.center) @ b.axes.T) <= b.size / 2).all(1).mean()
    volumes: Float[Array, "2"] = np.array([a.size.prod(), b.size.prod()])
    shared = inside * volumes[0]
    return float(shared / max(volumes.sum() - shared, 1e-30))


def pooled_f1(rows: Sequence[Score]) -> float | None:
    """Compute F1 over the things of all scenes, and so with false ones where none is true; None without any
    things."""
    seen, found, false = (sum(getattr(row, name) for row in rows) for name in ("seen", "found", "false"))
    return 2 * found / (seen + found + false) if seen + false else None


def _summary(word: str, rows: Sequence[Score]) -> list[str | None]:
    there, f1 = [row for row in rows if row.seen], pooled_f1(rows)
    sums = [str(sum(getattr(row, name) for row in rows)) for name in ("seen", "found", "false")]
    told = None if f1 is None else f"{f1:.2f}"
    if not there:
        return [word, *sums, told, *[None] * 4]
    ious, marked = ([iou for row in there for iou in getattr(row, name)] for name in ("ious", "marked_ious"))
    in_range = np.mean([row.count[1] <= row.seen <= row.count[2] for row in there])
    return [word, *sums, told, f"{np.median([row.off for row in there]):.0%}", f"{in_range:.0%}",
            *(f"{np.mean(iou):.2f}" if iou else None for iou in (ious, marked))]  # fmt: skip
