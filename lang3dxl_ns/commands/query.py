"""`lang3dxl query`: text queries from the shell."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
import tyro
from PIL import Image

from lang3dxl_ns.commands.of_scene import OfScene
from lang3dxl_ns.common.console import say, some, tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import make_folder, replace_file, slugs
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.files.coco import CocoLabels, check_labels_file
from lang3dxl_ns.open_scene import load_scene
from lang3dxl_ns.query.answer import best_views
from lang3dxl_ns.query.match import Match, save_picture, together
from lang3dxl_ns.query.question import QueryConfig, Question
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt, caution, listed_phrases, parse_prompts

Negatives = Annotated[tyro.conf.UseAppendAction[list[str]], tyro.conf.arg(name="not")]
"""Negatives of all texts, a flag `--not` that can be repeated."""


@showing("scene", "text", "not_", "out", "image", "all", "coco", "settings")
@dataclass(kw_only=True)
class Query(OfScene):
    """Search a trained scene for texts: write heat maps, masks and relevancy maps.

    Each text gets a folder in --out. For every view, it holds `….overlay.png` (heat map over the rendering),
    `….mask.png` and `….npy` (relevancy, float32). `query.json` lists prompts and results. Without --image
    or --all, each text gets the training view that shows it best. Views that several texts share are also
    written as one picture to `together`, with a color for each text and a legend.
    """

    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Text to search for, such as '"windows" not "arcades"'. Repeat the flag, or separate texts with `;`."""
    not_: Negatives = field(default_factory=list)
    """Negative for all texts, such as arcades. Repeat the flag for more."""
    out: Path = Path("found")
    """Folder for the results."""
    image: str | None = None
    """Use the view of this photo, by name."""
    all: bool = False
    """Use the views of all photos, including held-out ones."""
    coco: Path | None = None
    """COCO file to which the masks of all photos and texts are also written as labels. It needs --all."""
    without_taught: bool = False
    """Search for the texts only, without what the scene was taught by example (lang3dxl teach)."""
    settings: Annotated[QueryConfig, tyro.conf.arg(name="")] = field(default_factory=QueryConfig)

    def main(self) -> None:
        if self.coco is not None and not self.all:
            raise UserError("--coco labels all photos: give --all too")
        if self.coco is not None:
            check_labels_file(self.coco)
        if self.image is not None and self.all:
            raise UserError("--image and --all exclude each other: give one of them")
        if not parse_texts(self.text, self.not_):  # fail now rather than after the work
            raise UserError("there is no --text: say what to look for, such as --text windows")
        make_folder(self.out)
        scene = load_scene(self.scene, settings=self.settings, clip=self.clip)
        scene = scene.with_words(()) if self.without_taught else scene
        question = scene.ask(parse_texts(self.text, self.not_, scene.words))
        results = _Results(self.out, question)
        labels = CocoLabels([prompt.text for prompt in question.prompts])
        for name, photo, asked in tracked(self._places(scene, question), "rendering"):
            found = scene.matches(question, photo)
            matches = [found[i] for i in asked]
            results.add(name, asked, matches)
            if self.coco is not None:
                size = scene.file.photo(photo).file_size
                masks = (Image.fromarray(m.mask).resize(size, Image.Resampling.NEAREST) for m in matches)
                labels.add(photo, [np.asarray(mask) for mask in masks])
        if self.coco is not None:
            labels.write(self.coco)
        results.write_report(scene)
        say(*results.summary())

    def _places(self, scene: Scene, question: Question) -> list[tuple[str, str, Sequence[int]]]:
        """List file name (no suffix), photo, and prompts of every requested view."""
        everything: Sequence[int] = range(len(question.prompts))
        if self.all:
            asked = {photo.name: everything for photo in scene.photos}
        elif self.image is not None:
            asked = {scene.file.photo(self.image).name: everything}
        else:
            best = best_views(scene, question)
            asked = {photo: [i for i in everything if best[i] == photo] for photo in best}
        return list(zip(file_names(list(asked)), asked, asked.values(), strict=True))


class _Results:
    """What a query writes: a folder for each text, views that several texts share, and query.json."""

    def __init__(self, out: Path, question: Question) -> None:
        self.out, self.question, self.views = out, question, list[dict[str, Any]]()
        texts = [prompt.text for prompt in question.prompts]
        *self.folders, self.shared = (out / slug for slug in slugs([*texts, "together"]))
        self.best = [(False, -1.0, "")] * len(texts)
        """For each text whether its best view shows a match, the score there, and the place."""
        self.written = set[Path]()

    def add(self, name: str, asked: Sequence[int], matches: Sequence[Match]) -> None:
        """Write a view's pictures and maps. asked: which texts the matches answer."""
        for i, match in zip(asked, matches, strict=True):
            match.save(self.folders[i] / f"{name}.overlay.png")
            self.written.add(match.save(self.folders[i] / f"{name}.npy"))
            save_picture(match.mask * np.uint8(255), self.folders[i] / f"{name}.mask.png")
            where = f"pixel {match.peak[0]}, {match.peak[1]} of {name}"
            self.best[i] = max(self.best[i], (match.area > 0, match.score, where))
        if len(matches) > 1:
            self.written.add(save_picture(together(matches), self.shared / f"{name}.png"))
        seconds = {"render_seconds": matches[0].view.seconds, "query_seconds": matches[0].seconds}
        found = [{"text": m.prompt.text, "peak": m.peak, "score": m.score, "area": m.area} for m in matches]
        self.views.append({"view": name, **seconds, "matches": found})

    def write_report(self, scene: Scene) -> None:
        """Write query.json: what is known about each text, and what each view shows."""
        q, texts = self.question, []
        judged = zip(q.prompts, q.doubts, q.trusts, q.thresholds, self.folders, strict=True)
        for prompt, doubt, trust, threshold, folder in judged:
            told: dict[str, Any] = {"text": prompt.text, "negatives": list(prompt.negatives)}
            told |= {"synonyms": scene.synonyms(prompt), "taught": prompt.taught is not None}
            told |= {"doubt": doubt, "trust": asdict(trust), "threshold": threshold, "folder": folder.name}
            texts.append(told)
        report = json.dumps({"texts": texts, "views": self.views}, indent=2, ensure_ascii=False)
        replace_file(self.out / "query.json", report + "\n")

    def summary(self) -> Iterator[str]:
        """Say where each text is found best, and which files an earlier query left."""
        prompts, trusts = self.question.prompts, self.question.trusts
        for prompt, trust, folder, best in zip(prompts, trusts, self.folders, self.best, strict=True):
            (matches_there, score, where), taught = best, prompt.taught is not None
            closest = "" if matches_there else " (no match; this view comes closest)"
            yield f"{prompt.text}{' (taught)' if taught else ''}: {score:.2f} at {where}; {folder}{closest}"
            advice = None if taught else caution(prompt.text)
            yield from (f"  {line}" for line in (advice, str(trust)) if line)
        ours = [*self.out.glob("*/*.npy"), *self.shared.glob("*.png")]  # a user may have other folders there
        if old := sorted({path.parent.name for path in {*ours} - self.written}):
            yield f"{self.out} still has files of an earlier query, not listed in query.json: {some(old)}"


def parse_texts(
    texts: Sequence[str], apart_from: Sequence[str] = (), names: Iterable[str] = ()
) -> list[Prompt]:
    """Parse the prompts of --text, each once and with the negatives of --not; `names` are never split."""
    prompts = dict.fromkeys(prompt for text in texts for prompt in parse_prompts(text, names))
    rivals = listed_phrases(apart_from)
    return [replace(prompt, negatives=(*prompt.negatives, *rivals)) for prompt in prompts]


_LONGEST_NAME = 200
"""Longest file name without suffixes, bytes. File systems allow 255 with suffixes."""


def file_names(photos: list[str]) -> list[str]:
    """Choose a unique file name (no suffix) for each photo. For example, a.jpg beside a.png becomes a_jpg."""
    stems = [str(PurePosixPath(photo).with_suffix("")).replace("/", "_") for photo in photos]
    whole = [photo.replace("/", "_").replace(".", "_") for photo in photos]
    names = [stem if stems.count(stem) == 1 else name for stem, name in zip(stems, whole, strict=True)]
    names = [name.encode()[:_LONGEST_NAME].decode("utf-8", "ignore") for name in names]
    return [n if names.count(n) == 1 else f"{n}-{i + 1}" for i, n in enumerate(names)]
