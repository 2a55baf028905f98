"""`lang3dxl query` and `lang3dxl export`: text queries from the shell."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Bool
from numpy import ndarray as Array
from PIL import Image
from scipy.ndimage import find_objects, label

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say, some, tracked
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import make_folder, read_json, read_names, replace_file, slugs, write_atomically
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.files.scene_file import Provenance, check_scene_name, replace_scene
from lang3dxl_ns.files.splat_file import check_splat_name
from lang3dxl_ns.open_scene import load_scene, provenance_of
from lang3dxl_ns.query.answer import best_views
from lang3dxl_ns.query.match import save_picture, together
from lang3dxl_ns.query.question import QueryConfig, Question
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt, caution, listed_phrases, parse_prompts
from lang3dxl_ns.query.trust import Trust
from lang3dxl_ns.query.vocabulary import whole_words
from lang3dxl_ns.web.video import RATE, tour_shots, write_video
from lang3dxl_ns.web.write_page import Page, write_page
from lang3dxl_ns.words.taught_words import run_lengths

_LEAST_PART = 1e-4
"""Share of a photo below which a separate part of a mask is no label."""
_NEAREST = Image.Resampling.NEAREST
_READ_BY: dict[str, tuple[str, ...]] = dict.fromkeys(("title", "credit", "license"), ("web", "scene_file"))
_READ_BY |= dict.fromkeys(("text", "not_", "look"), ("out", "web"))
_READ_BY |= {"vocabulary": ("web",), "photos": ("web",), "all": ("out",), "hide_floaters": ("out",)}
"""Targets of `export` that read an option. Options that are not listed are read by every target."""
_Not = Annotated[tyro.conf.UseAppendAction[list[str]], tyro.conf.arg(name="not")]


@showing("scene", "text", "not_", "out", "image", "all", "coco", "settings")
@dataclass(kw_only=True)
class Query:
    """Search a trained scene for texts: write heat maps, masks and relevancy maps.

    Each text gets a folder in --out. For every view, it holds `….overlay.png` (heat map over the rendering),
    `….mask.png` and `….npy` (relevancy, float32). `query.json` lists prompts and results. Without --image
    or --all, each text gets the training view that shows it best. Views that several texts share are also
    written as one picture to `together`, with a color for each text and a legend.
    """

    scene: tyro.conf.Positional[Path | None] = None
    """A .scene file, a folder that holds one, or a run (default: the newest run under outputs/)."""
    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Text to search for, such as '"windows" not "arcades"'. Repeat the flag, or separate texts with `;`."""
    not_: _Not = field(default_factory=list)
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
    clip: str | None = None
    """Name or folder of the scene's CLIP, if it is not where the scene file says."""
    settings: Annotated[QueryConfig, tyro.conf.arg(name="")] = field(default_factory=QueryConfig)

    def main(self) -> None:
        if self.coco is not None and not self.all:
            raise UserError("--coco labels all photos: give --all too")
        if self.coco is not None and (self.coco.suffix != ".json" or self.coco.is_dir()):
            raise UserError(f"--coco writes labels as JSON: {self.coco} is not the name of a .json file")
        if self.coco is not None and self.coco.is_file() and self.coco.stat().st_size:
            with readable(f"{self.coco} is another file than one of labels", "choose another name"):
                expect({"images", "annotations"} <= {*read_json(self.coco, 1 << 31)}, "it has no annotations")
        if self.image is not None and self.all:
            raise UserError("--image and --all exclude each other: give one of them")
        prompts = parse_texts(self.text, self.not_)  # fail now rather than after the work
        if not prompts:
            raise UserError("there is no --text: say what to look for, such as --text windows")
        make_folder(self.out)
        scene = load_scene(self.scene, settings=self.settings, clip=self.clip)
        scene = scene.with_words(()) if self.without_taught else scene
        question = scene.ask(parse_texts(self.text, self.not_, scene.words))
        prompts = list(question.prompts)
        *folders, shared = (self.out / slug for slug in slugs([*(p.text for p in prompts), "together"]))
        labels, views, written = CocoLabels([prompt.text for prompt in prompts]), [], set[Path]()
        best = [(False, -1.0, "")] * len(prompts)
        for name, place, asked in tracked(self._places(scene, question), "rendering"):
            wanted = question if len(asked) == len(prompts) else scene.ask([prompts[i] for i in asked])
            matches = scene.matches(wanted, place)
            for i, match in zip(asked, matches, strict=True):
                match.save(folders[i] / f"{name}.overlay.png")
                written.add(match.save(folders[i] / f"{name}.npy"))
                save_picture(match.mask * np.uint8(255), folders[i] / f"{name}.mask.png")
                where = f"pixel {match.peak[0]}, {match.peak[1]} of {name}"
                best[i] = max(best[i], (match.area > 0, match.score, where))
            if self.coco is not None:
                size = scene.file.photo(place).file_size
                masks = [Image.fromarray(match.mask).resize(size, _NEAREST) for match in matches]
                labels.add(place, [np.asarray(mask) for mask in masks])
            if len(matches) > 1:
                written.add(save_picture(together(matches), shared / f"{name}.png"))
            found = [
                {"text": m.prompt.text, "peak": m.peak, "score": m.score, "area": m.area} for m in matches
            ]
            seconds = {"render_seconds": matches[0].view.seconds, "query_seconds": matches[0].seconds}
            views.append({"view": name, **seconds, "matches": found})
        if self.coco is not None:
            write_atomically(self.coco, json.dumps(labels.content) + "\n")
        texts = list(zip(prompts, question.trusts, question.thresholds, folders, strict=True))
        reports = zip(question.doubts, texts, strict=True)
        report = {"texts": [_text_report(scene, d, *text) for d, text in reports], "views": views}
        replace_file(self.out / "query.json", json.dumps(report, indent=2, ensure_ascii=False) + "\n")
        for (prompt, trust, _, folder), (matches_there, score, where) in zip(texts, best, strict=True):
            taught = prompt.taught is not None
            closest = "" if matches_there else " (no match; this view comes closest)"
            say(f"{prompt.text}{' (taught)' if taught else ''}: {score:.2f} at {where}; {folder}{closest}")
            advice = None if taught else caution(prompt.text)
            say(*(f"  {line}" for line in (advice, str(trust)) if line))
        ours = [*self.out.glob("*/*.npy"), *shared.glob("*.png")]  # a user may have other folders there
        if old := sorted({path.parent.name for path in {*ours} - written}):
            say(f"{self.out} still has files of an earlier query, not listed in query.json: {some(old)}")

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


class CocoLabels:
    """A data set in COCO's format, with an annotation for each connected part of each mask."""

    def __init__(self, categories: Sequence[str]) -> None:
        self.content: dict[str, Any] = {
            "info": {"description": "Matches in a scene of lang3dxl-ns, drawn on the undistorted photos"},
            "images": [],
            "annotations": [],
            "categories": [{"id": i, "name": name} for i, name in enumerate(categories, start=1)],
        }
        """Content of the COCO file."""

    def add(self, photo: str, masks: Sequence[Bool[Array, "h w"]]) -> None:
        """Add a photo by name, with one mask per category, at the size of the photo's file."""
        images, annotations = self.content["images"], self.content["annotations"]
        height, width = masks[0].shape
        images.append({"id": len(images) + 1, "file_name": photo, "width": width, "height": height})
        for category, mask in enumerate(masks, start=1):
            numbers, _ = label(mask)
            for number, place in enumerate(find_objects(numbers), start=1):
                part = numbers[place] == number
                area = int(np.count_nonzero(part))
                if area < _LEAST_PART * mask.size:
                    continue
                rows, columns = place
                box = [columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start]
                outline = {"size": [height, width], "counts": _runs(part, place, mask.shape)}
                labeled = {"id": len(annotations) + 1, "image_id": len(images), "category_id": category}
                found = {"segmentation": outline, "area": area, "bbox": box, "iscrowd": 0}
                annotations.append({**labeled, **found})


def _runs(part: Bool[Array, "r c"], place: tuple[slice, slice], size: tuple[int, ...]) -> list[int]:
    """Return the `run_lengths` of a mask of this size with one part at a place, from its columns alone."""
    (rows, columns), (height, width) = place, size
    runs = run_lengths(np.pad(part, ((rows.start, height - rows.stop), (0, 0))))
    runs[0] += height * columns.start
    runs += [0] * (len(runs) % 2 == 0)
    runs[-1] += height * (width - columns.stop)
    return runs if runs[-1] else runs[:-1]


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


def _text_report(
    scene: Scene, doubt: float, prompt: Prompt, trust: Trust, threshold: float, folder: Path
) -> dict[str, Any]:
    taught, synonyms = prompt.taught is not None, scene.synonyms(prompt)
    told = {"text": prompt.text, "negatives": list(prompt.negatives), "synonyms": synonyms, "taught": taught}
    told |= {"doubt": doubt, "trust": asdict(trust)}
    return told | {"threshold": threshold, "folder": folder.name}


@showing("scene", "text", "not_", "out", "web", "scene_file", "video", "title", "all", "look", "settings")
@dataclass(kw_only=True)
class Export:
    """Write a scene in another form. --out writes a splat file of the Gaussians that match a text, in the
    model's frame, which ordinary viewers open. --web writes a web page that answers words by itself.
    --scene-file writes the scene itself to one file, which can be queried without its run and photos."""

    scene: tyro.conf.Positional[Path | None] = None
    """A .scene file, a folder that holds one, or a run (default: the newest run under outputs/)."""
    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Text to search for (default: write everything). With --web, prompts that the page opens with."""
    not_: _Not = field(default_factory=list)
    """Negative for all texts. Repeat the flag for more."""
    out: Path | None = None
    """Splat file to write, .ply, .spz, .sog or .glb."""
    web: Path | None = None
    """Folder for a web page that any static server can serve."""
    video: Path | None = None
    """Video to write, such as out.mp4, of the tour that the page kept in the scene's file (needs ffmpeg)."""
    vocabulary: Path | None = None
    """File of more words that may name a place on the page, one per line."""
    photos: Path | None = None
    """Folder of the scene's photos, of which the page shows small copies (default: none are published)."""
    scene_file: Path | None = None
    """Scene file to write, NAME.scene, or NAME.glb or NAME.spz, which splat viewers show too."""
    title: str = ""
    """Title of page and scene (default: the scene's own, or the name of the photos' folder)."""
    credit: str = ""
    """Line about the photos: who took them."""
    license: str = ""
    """Terms under which photos and scene may be used."""
    all: bool = False
    """Write all Gaussians. With --text, a .ply has their relevancy as a property."""
    hide_floaters: bool = False
    """Leave out Gaussians that float where no surface is. A page opens with them hidden anyway."""
    index: Path | None = None
    """File (.npy or .txt) for the indices of the matching Gaussians, in the order of the scene, which is also
    the order of the splat that it was attached to. It needs --text and --out."""
    look: str | None = None
    """Training photo whose lighting is used, by name (default: the photo that best shows the whole scene)."""
    clip: str | None = None
    """Name or folder of the scene's CLIP, if it is not where the scene file says."""
    settings: Annotated[QueryConfig, tyro.conf.arg(name="")] = field(default_factory=QueryConfig)

    def main(self) -> None:
        targets = [n for n in ("out", "web", "scene_file", "video") if getattr(self, n) is not None]
        if len(targets) != 1:
            raise UserError("give one of --out FILE.ply, --web FOLDER, --scene-file NAME.scene, --video FILE")
        if ignored := [n for n, by in _READ_BY.items() if getattr(self, n) and targets[0] not in by]:
            option, target = (name.strip("_").replace("_", "-") for name in (ignored[0], targets[0]))
            raise UserError(f"--{option} has no effect on --{target}: leave it off")
        if self.not_ and not self.text:
            raise UserError("--not is a negative of texts: give --text too, or leave it off")
        if self.index is not None and (self.out is None or not self.text):
            raise UserError("--index lists the Gaussians that match: give --text and --out with it")
        if self.settings != QueryConfig() and not self.text and self.web is None:
            raise UserError("settings of queries have no effect without --text: leave them off, or give one")
        prompts = parse_texts(self.text, self.not_)
        if self.scene_file is not None:
            check_scene_name(self.scene_file)
        if self.out is not None:
            make_folder(self.out.parent)
            check_splat_name(self.out)
            if len(prompts) > 1:
                raise UserError("a splat file is of one --text: write several files, or a page (--web)")
        scene = load_scene(self.scene, settings=self.settings, clip=self.clip)
        prompts = parse_texts(self.text, self.not_, scene.words)
        if self.scene_file is not None:
            _, size = replace_scene(self.scene_file, scene, self._told())
            ask = f"lang3dxl query {shlex.quote(str(self.scene_file))}"
            say(f"Wrote {size / 1e6:.1f} MB to {self.scene_file}; ask it: {ask}")
        if self.web is not None:
            own = read_names(self.vocabulary, "words") if self.vocabulary else ()
            words = self._clip_words(scene.file.clip)
            page = Page(scene, prompts, own, words, self._told(), self.look, self.photos)
            size = write_page(page, self.web)
            for left_out in page.left_out:
                say(f"{left_out}.")
            see = f"python -m http.server -d {shlex.quote(str(self.web))}"
            say(f"Wrote {size / 1e6:.1f} MB to {self.web}; see it: {see}")
        if self.video is not None:
            count = write_video(self.video, scene, tour_shots(scene, self._told().tour))
            say(f"Wrote {count} pictures, {count / RATE:.0f} seconds, to {self.video}")
        if self.out is not None:
            text = prompts[0] if prompts else None
            count = scene.export(
                self.out,
                text,
                everything=self.all,
                look=self.look,
                index=self.index,
                hide_floaters=self.hide_floaters,
            )
            say(f"Wrote {count} of {len(scene.splats)} Gaussians to {self.out}")

    def _clip_words(self, clip: str | None) -> tuple[str, ...]:
        """Return the words of the CLIP's tokenizer; empty on a machine without that CLIP."""
        if (name := self.clip or clip) is None:  # a scene of colors alone
            return ()
        try:
            return whole_words(name)
        except UserError as error:
            say(f"The page knows the shipped words alone: {error}")
            return ()

    def _told(self) -> Provenance:
        """Return the provenance in the scene's own file, with what the flags override."""
        flags = {"title": self.title, "credit": self.credit, "license": self.license}
        told = {name: text for name, text in flags.items() if text}
        return replace(provenance_of(self.scene), made_by=Provenance.made_by, **told)
