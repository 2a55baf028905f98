"""`lang3dxl benchmark trust`: how often wrong answers carry a caution, and right ones none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from sklearn.metrics import average_precision_score

from lab.reports import command_line
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import markdown_table, write_report
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.score_scene import labeled_photos, truths_of
from lang3dxl_ns.query.doubt import peaks
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.query.trust import CLEARLY, FAINT, STRICTEST, alike, least_peak

ABSENT = (
    "whale", "fridge", "bicycle", "piano", "sofa", "elephant", "ship", "airplane", "laptop", "bottle",
    "guitar", "horse", "umbrella", "ferris wheel", "escalator", "skyscraper", "pagoda", "windmill",
    "lighthouse", "obelisk", "pyramid", "drawbridge", "igloo", "scaffolding", "chandelier", "fireplace",
    "bathtub", "mailbox", "traffic light", "swimming pool", "torii gate", "totem pole", "satellite dish",
    "solar panel", "telephone booth", "construction crane", "bus stop", "vending machine", "parking meter",
    "statue of liberty",
)  # fmt: skip
"""Things that no scene shows."""
RIGHT, WRONG = 0.6, 0.2
"""Average precision from which an answer is right, and below which it is wrong."""
_STEP = 3
"""Every third pixel is scored."""


@showing("scene", "ground_truth", "out")
@dataclass
class TrustBenchmark:
    """Ask scenes every word with labels, and forty words for absent things."""

    scene: tuple[Path, ...]
    """Scene files or runs, as `lang3dxl query` takes them."""
    ground_truth: tuple[Path, ...]
    """Labels of each scene's photos."""
    out: Path
    """Folder for trust.md."""
    absent: tuple[str, ...] = field(default=ABSENT)
    """Words for things that no scene shows."""
    photos: int = 4
    """Most photos of each scene that are scored."""

    def main(self) -> None:
        from lang3dxl_ns.open_scene import load_scene

        if len(self.scene) != len(self.ground_truth):
            raise UserError("give as many --ground-truth folders as scenes")
        answers, foreign = list[Judged](), dict[str, float | None]()
        for path, truth in zip(self.scene, self.ground_truth, strict=True):
            scene = load_scene(path)
            folder = truth.parent if truth.name == "ground_truth" else truth
            name = folder.parent.name if folder.name == "scene" else folder.name  # of a demo
            foreign[name] = scene.foreignness
            answers += self.judged(name, scene, GroundTruth(truth))
        levels = {name: threshold([one for one in answers if one.scene != name]) for name in foreign}
        elsewhere = [one.cautioned_at(levels[one.scene]) for one in answers]
        kinds = {
            "absent": ([one.precision is None for one in answers], ">= 85 %"),
            f"present and wrong, AP < {WRONG}": (
                [one.wrong and one.precision is not None for one in answers],
                ">= 85 %",
            ),
            f"right, AP >= {RIGHT}": ([one.right for one in answers], "<= 8 %"),
        }
        shares = [
            [
                kind,
                sum(which),
                share([one.level != "sure" for one in answers], which),
                share(elsewhere, which),
                goal,
            ]
            for kind, (which, goal) in kinds.items()
        ]
        told = [
            [one.scene, one.word, one.told_precision, f"{one.peak:.2f}", one.level]
            for one in answers
            if one.precision is not None or one.level == "sure"
        ]
        worlds = [
            [name, "" if far is None else f"{far:.2f}", f"{levels[name]:.2f}"]
            for name, far in foreign.items()
        ]
        tables = [
            markdown_table(
                ["answers", "number", "cautioned", "threshold from the other scenes", "goal"], shares
            ),
            markdown_table(["scene", "foreignness", "CLEARLY from the others"], worlds),
            markdown_table(["scene", "word", "AP", "peak", "trust"], told),
        ]
        rows = [vars(one) for one in answers]
        command = command_line("lang3dxl benchmark trust", self)
        text = "\n\n".join(["# Trust", f"    {command}", *tables]) + "\n"
        write_report(self.out, "trust", text, {"rows": rows, "foreignness": foreign})
        print(text)

    def judged(self, name: str, scene: Scene, truth: GroundTruth) -> list[Judged]:
        """Judge every word with a label, and the absent ones."""
        labeled = scene.ask([Prompt(word) for word in truth.categories])
        scores: dict[str, list[float]] = {word: [] for word in truth.categories}
        photos = labeled_photos(scene, truth, "all")
        for photo in photos[:: max(len(photos) // self.photos, 1)][: self.photos]:
            camera = photo.camera
            truths = truths_of(truth, photo.photo(), (camera.height, camera.width))
            matches = scene.matches(labeled, photo.name, max(camera.height, camera.width))
            for word, match in zip(truth.categories, matches, strict=True):
                label = truths.get(word)
                if label is not None and label.mask.any():
                    where = np.asarray(label.mask).ravel()[::_STEP]
                    scores[word].append(average_precision_score(where, match.relevancy.ravel()[::_STEP]))
        absent = scene.ask([Prompt(word) for word in self.absent])
        raised = least_peak(scene.foreignness) - CLEARLY
        found = []
        for question in (labeled, absent):
            fits = peaks(scene.engine.of_gaussians(question.queries)).tolist()
            for prompt, trust, fit, own in zip(
                question.prompts, question.trusts, fits, question.gaussians, strict=True
            ):
                precision = float(np.mean(scores[prompt.text])) if scores.get(prompt.text) else None
                if question is labeled and precision is None:
                    continue
                same = alike(prompt.text, scene.synonyms(prompt), own, scene.anchors)
                anyway = trust.level == "doubtful" or bool(same)
                found.append(Judged(name, prompt.text, precision, fit, trust.level, raised, anyway))
        return found


@dataclass
class Judged:
    """A word's answer in a scene, and how it was trusted."""

    scene: str
    word: str
    precision: float | None
    """Average precision over the labeled photos; None for what is absent."""
    peak: float
    level: str
    raised: float
    """By how much the scene's foreignness raises the peak that is asked for."""
    anyway: bool
    """Whether a caution does not depend on `CLEARLY`."""

    @property
    def told_precision(self) -> str:
        return "absent" if self.precision is None else f"{self.precision:.2f}"

    @property
    def right(self) -> bool:
        return self.precision is not None and self.precision >= RIGHT

    @property
    def wrong(self) -> bool:
        return self.precision is None or self.precision < WRONG

    def cautioned_at(self, clearly: float) -> bool:
        """Return whether the answer would have a caution if `CLEARLY` were this."""
        return self.anyway or self.peak < min(clearly + self.raised, STRICTEST)


def threshold(answers: Sequence[Judged]) -> float:
    """Choose `CLEARLY` where the shares of wrong answers with a caution and of right ones without are the
    largest in sum: the middle of the best levels."""
    levels = np.linspace(FAINT, 1, 101)
    right, wrong = [a for a in answers if a.right], [a for a in answers if a.wrong]
    merit = [
        np.mean([a.cautioned_at(x) for a in wrong] or [False])
        - np.mean([a.cautioned_at(x) for a in right] or [False])
        for x in levels
    ]
    return float(np.median(levels[np.isclose(merit, max(merit))]))


def share(cautioned: Sequence[bool], which: Sequence[bool]) -> str:
    """Write how many of some answers are cautioned."""
    chosen = [one for one, counts in zip(cautioned, which, strict=True) if counts]
    return f"{sum(chosen)} of {len(chosen)}"
