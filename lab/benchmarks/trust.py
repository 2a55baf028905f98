"""`lang3dxl benchmark trust`: how often wrong answers carry a caution, and right ones none."""

from __future__ import annotations

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
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt

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
        rows, foreign = list[list[object]](), dict[str, float | None]()
        for path, truth in zip(self.scene, self.ground_truth, strict=True):
            scene = load_scene(path)
            name = truth.name if truth.name != "ground_truth" else truth.parent.parent.name
            foreign[name] = scene.foreignness
            rows += [[name, *row] for row in self.judged(scene, GroundTruth(truth))]
        right = [row for row in rows if row[2] is not None and float(str(row[2])) >= RIGHT]
        wrong = [row for row in rows if row[2] is None or float(str(row[2])) < WRONG]
        cautioned = [sum(row[3] != "sure" for row in some) for some in (wrong, right)]
        shares = [
            ["wrong or absent, cautioned", f"{cautioned[0]} of {len(wrong)}", ">= 85 %"],
            ["right, cautioned", f"{cautioned[1]} of {len(right)}", "<= 8 %"],
        ]
        labeled = [[*row[:2], f"{row[2]:.2f}", row[3]] for row in rows if row[2] is not None]
        missed = [[*row[:2], "absent", row[3]] for row in wrong if row[2] is None and row[3] == "sure"]
        worlds = [[name, "" if far is None else f"{far:.2f}"] for name, far in foreign.items()]
        tables = [
            markdown_table(["", "answers", "goal"], shares),
            markdown_table(["scene", "foreignness"], worlds),
            markdown_table(["scene", "word", "AP", "trust"], [*labeled, *missed]),
        ]
        command = command_line("lang3dxl benchmark trust", self)
        text = "\n\n".join(["# Trust", f"    {command}", *tables]) + "\n"
        write_report(self.out, "trust", text, {"rows": rows, "foreignness": foreign})
        print(text)

    def judged(self, scene: Scene, truth: GroundTruth) -> list[tuple[str, float | None, str]]:
        """Return each word with its average precision (None if it is absent, or has no label) and trust."""
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
        present = zip(scores, labeled.trusts, strict=True)
        found: list[tuple[str, float | None, str]] = [
            (word, float(np.mean(scores[word])), trust.level) for word, trust in present if scores[word]
        ]
        absent = scene.ask([Prompt(word) for word in self.absent])
        return found + [(p.text, None, t.level) for p, t in zip(absent.prompts, absent.trusts, strict=True)]
