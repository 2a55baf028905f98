"""`python -m lab.benchmarks.typed_words`: fifty prompts as people type them, each judged by labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import tyro

from lab.reports import command_line
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import markdown_table, write_report
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.score_scene import labeled_photos, truths_of
from lang3dxl_ns.evaluation.scores import overlap
from lang3dxl_ns.query.doubt import DOUBTFUL
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt, caution
from lang3dxl_ns.scene.record import ScenePhoto

USEFUL = 0.3
"""Mean IoU of the masks from which an answer is useful."""
PROMPTS: dict[str, tuple[str, ...]] = {
    "windows": ("windows", "window", "a window", "lancet windows", "panes", "upper windows", "dark windows",
                "windows on the left tower", "fenêtre"),
    "portals": ("portals", "door", "doors", "the entrance", "gate", "doorway", "main entrance",
                "the big door at the front", "Eingang"),
    "towers": ("towers", "tower", "bell tower", "belfry", "steeple", "the left tower"),
    "spires": ("spires", "spire", "pointed roof of a tower", "fleche"),
    "domes": ("domes", "dome", "cupola", "the big round roof"),
    "minarets": ("minarets", "minaret"),
    "": ("whale", "fridge", "bicycle", "traffic light", "ferris wheel", "swimming pool", "skyscraper",
         "unicorn", "airplane", "escalator", "xqzzy", "glimworp", "42", "the", "asdf jkl", "?"),
}  # fmt: skip
"""By the category that they mean; "" for what no scene shows, and for what means nothing."""
Verdict: TypeAlias = Literal["useful", "doubtful", "wrong"]


@dataclass
class TypedWords:
    """Ask scenes fifty prompts as people type them, plurals, specialist words, places, other languages,
    absent things and nonsense, and judge each: useful, honestly doubtful, or wrong without a warning."""

    scene: tuple[Path, ...]
    """Scene files or runs, as `lang3dxl query` takes them."""
    ground_truth: tuple[Path, ...]
    """Labels of each scene's photos."""
    out: Path
    """Folder for typed_words.md."""

    def main(self) -> None:
        from lang3dxl_ns.open_scene import load_scene

        if len(self.scene) != len(self.ground_truth):
            raise UserError("give as many --ground-truth folders as scenes")
        verdicts = {
            str(path): judged(load_scene(path), GroundTruth(truth))
            for path, truth in zip(self.scene, self.ground_truth, strict=True)
        }
        counts = Counter(verdict for found in verdicts.values() for verdict, _ in found.values())
        total = sum(counts.values())
        shares = markdown_table(
            ["", "share"], [[name, f"{n / total:.0%}"] for name, n in counts.most_common()]
        )
        prompts = [text for texts in PROMPTS.values() for text in texts]
        rows = [[p, *(" ".join(filter(None, found[p])) for found in verdicts.values())] for p in prompts]
        each = markdown_table(["prompt", *(Path(name).name for name in verdicts)], rows)
        command = command_line("python -m lab.benchmarks.typed_words", self)
        text = f"# Typed words\n\n    {command}\n\n{shares}\n\n{each}\n"
        write_report(self.out, "typed_words", text, {"shares": dict(counts), "scenes": verdicts})
        print(text)


def judged(scene: Scene, truth: GroundTruth) -> dict[str, tuple[Verdict, str]]:
    """The verdict on each prompt, and the IoU that it rests on.

    A prompt for a thing that the scene's labels show is useful if its masks have `USEFUL` in the mean over
    the photos that show it. All others, and those for things without labels here, should be doubted: by the
    scene, or by a caution about the words.
    """
    photos, found = labeled_photos(scene, truth, "all"), dict[str, tuple[Verdict, str]]()
    for category, texts in PROMPTS.items():
        question = scene.ask([Prompt(text) for text in texts])
        ious = mask_ious(scene, truth, photos, category, texts) if category in truth.categories else None
        for i, (text, doubt) in enumerate(zip(texts, question.doubts, strict=True)):
            score = "" if ious is None else f"{ious[i]:.2f}"
            honest = doubt > DOUBTFUL or caution(text) is not None
            useful = ious is not None and ious[i] >= USEFUL
            found[text] = ("useful" if useful else "doubtful" if honest else "wrong", score)
    return found


def mask_ious(
    scene: Scene, truth: GroundTruth, photos: Sequence[ScenePhoto], category: str, texts: Sequence[str]
) -> list[float]:
    """Mean IoU of each prompt's masks with a category's labels, in the photos that show it."""
    question, ious = scene.ask([Prompt(text) for text in texts]), list[list[float]]()
    for photo in photos:
        camera = photo.camera
        label = truths_of(truth, photo.photo(), (camera.height, camera.width)).get(category)
        if label is not None and label.mask.any():
            matches = scene.matches(question, photo.name, max(camera.width, camera.height))
            ious.append([overlap(match.mask, label.mask)["iou"] for match in matches])
    return [float(v) for v in np.mean(ious, axis=0)] if ious else [0.0] * len(texts)


if __name__ == "__main__":
    tyro.cli(TypedWords).main()
