"""`lang3dxl query` and `lang3dxl export`: text queries from the shell."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
import tyro

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import make_folder, slugs, write_atomically
from lang3dxl_ns.common.reports import progress_bar
from lang3dxl_ns.query.doubt import doubtful
from lang3dxl_ns.query.match import Match, save_picture, together
from lang3dxl_ns.query.run_file import read_camera_path
from lang3dxl_ns.query.scene import QueryConfig, Scene
from lang3dxl_ns.query.splat_file import check_splat_name
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.query.web.write_page import write_page
from lang3dxl_ns.scene.camera import Camera


@dataclass(kw_only=True)
class Query:
    """Search a trained scene for texts: writes heat maps, masks and relevancy maps.

    For every text, a folder in --out with, for every view, `….overlay.png` (heat map over the rendering),
    `….mask.png` and `….npy` (relevancy, float32); `query.json` lists prompts and results. Without
    --image, --all or --camera-path, each text gets the training view that shows it best. Views that several
    texts share also come as one picture, with a color for each and a legend, in `together`.
    """

    run: tyro.conf.Positional[Path | None] = None
    """Folder of the run, or its config.yml (default: the newest under outputs/)."""
    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Text to look for; repeat the flag, or separate with `;`. Negatives: '"windows" not "arcades"'."""
    out: Path
    """Folder for the results."""
    image: str | None = None
    """Use the view of this photo, by name."""
    all: bool = False
    """Use the views of all photos, including held-out ones."""
    camera_path: Path | None = None
    """Use the views of a camera path saved by the viewer."""
    settings: Annotated[QueryConfig, tyro.conf.arg(name="")] = field(default_factory=QueryConfig)

    def main(self) -> None:
        from lang3dxl_ns.plugin.load_scene import load_scene

        if sum((self.image is not None, self.all, self.camera_path is not None)) > 1:
            raise UserError("--image, --all and --camera-path exclude each other: give one of them")
        make_folder(self.out)  # fail now rather than after the work
        scene = load_scene(self.run, settings=self.settings)
        prompts = scene.prompts(self.text)
        *folders, shared = (self.out / slug for slug in slugs([*(p.text for p in prompts), "together"]))
        views, best = [], [-1.0] * len(prompts)
        where, doubts, levels = [""] * len(prompts), [1.0] * len(prompts), [1.0] * len(prompts)
        with progress_bar() as bar:
            for name, place, asked in bar.track(self._places(scene, prompts), description="rendering"):
                matches = scene.match([prompts[i] for i in asked], place)
                for i, match in zip(asked, matches, strict=True):
                    write_match(match, folders[i] / name)
                    doubts[i], levels[i] = match.doubt, match.threshold
                    if match.score > best[i]:
                        best[i], where[i] = match.score, f"pixel {match.peak[0]}, {match.peak[1]} of {name}"
                if len(matches) > 1:
                    save_picture(together(matches), shared / f"{name}.png")
                views.append(_view_report(name, matches))
        texts = zip(prompts, doubts, levels, folders, strict=True)
        report = {"texts": [_text_report(scene, *text) for text in texts], "views": views}
        write_atomically(self.out / "query.json", json.dumps(report, indent=2, ensure_ascii=False) + "\n")
        found = zip(prompts, doubts, levels, folders, best, where, strict=True)
        for prompt, doubt, level, folder, score, place in found:
            closest = "" if score > level else " (no match; this view comes closest)"
            say(f"{prompt.text}: {score:.2f} at {place}; {folder}{closest}")
            if advice := doubtful(prompt.text, doubt):
                say(f"  {advice}")

    def _places(
        self, scene: Scene, prompts: Sequence[Prompt]
    ) -> list[tuple[str, Camera | str, Sequence[int]]]:
        """File name (no suffix) of every requested view, its camera or photo, and the prompts it is for."""
        everything = range(len(prompts))
        if self.camera_path is not None:
            return [(f"{i:05d}", c, everything) for i, c in enumerate(read_camera_path(self.camera_path))]
        if self.all:
            photos = [photo.name for photo in scene.photos]
            return [(n, p, everything) for n, p in zip(file_names(photos), photos, strict=True)]
        if self.image is not None:
            name = scene.file.photo(self.image).name
            return [(file_names([name])[0], name, everything)]
        best = scene.best_views(prompts)
        photos = list(dict.fromkeys(best))
        asked = [[i for i, b in enumerate(best) if b == photo] for photo in photos]
        return list(zip(file_names(photos), photos, asked, strict=True))


def file_names(photos: list[str]) -> list[str]:
    """A unique file name (no suffix) for each photo: a.jpg beside a.png becomes a_jpg."""
    stems = [str(PurePosixPath(photo).with_suffix("")).replace("/", "_") for photo in photos]
    whole = [photo.replace("/", "_").replace(".", "_") for photo in photos]
    names = [stem if stems.count(stem) == 1 else name for stem, name in zip(stems, whole, strict=True)]
    return [n if names.count(n) == 1 else f"{n}-{i + 1}" for i, n in enumerate(names)]


def write_match(match: Match, stem: Path) -> None:
    """Write `stem`.overlay.png, .mask.png and .npy."""
    match.save(stem.with_name(f"{stem.name}.overlay.png"))
    save_picture(match.mask.cpu().numpy() * np.uint8(255), stem.with_name(f"{stem.name}.mask.png"))
    match.save(stem.with_name(f"{stem.name}.npy"))


def _text_report(scene: Scene, prompt: Prompt, doubt: float, threshold: float, folder: Path) -> dict:
    return {
        "text": prompt.text,
        "negatives": list(prompt.negatives),
        "synonyms": scene.synonyms(prompt),
        "doubt": doubt,
        "threshold": threshold,
        "folder": folder.name,
    }


def _view_report(name: str, matches: list[Match]) -> dict:
    found = [
        {"text": m.prompt.text, "peak": m.peak, "score": m.score, "area": float(m.mask.float().mean())}
        for m in matches
    ]
    seconds = {"render_seconds": matches[0].view.seconds, "query_seconds": matches[0].seconds}
    return {"view": name, **seconds, "matches": found}


@dataclass(kw_only=True)
class Export:
    """Write the Gaussians that match a text to a splat file that ordinary viewers open (--out), in the
    model's frame; or a web page to walk through the scene, with a button for each text (--web).
    """

    run: tyro.conf.Positional[Path | None] = None
    """Folder of the run, or its config.yml (default: the newest under outputs/)."""
    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Text to look for (default: write everything); with --web, repeat the flag or separate with `;`."""
    out: Path | None = None
    """The .ply or .spz file to write."""
    web: Path | None = None
    """Folder for a web page that any static server can serve."""
    title: str = ""
    """Of the page (default: name of the photos' folder)."""
    credit: str = ""
    """Line on the page about the photos: who took them, and their licence."""
    all: bool = False
    """Write all Gaussians; with --text a .ply has their relevancy as a property."""
    index: Path | None = None
    """With --text and --out: file (.npy or .txt) for the numbers of the matching Gaussians, in the scene's
    order, which is that of the splat it was attached to."""
    look: str | None = None
    """Light of this training photo, by name (default: of the photo that shows the scene as a whole)."""
    settings: Annotated[QueryConfig, tyro.conf.arg(name="")] = field(default_factory=QueryConfig)

    def main(self) -> None:
        from lang3dxl_ns.plugin.load_scene import load_scene

        if (self.out is None) == (self.web is None):
            raise UserError("give one of --out FILE.ply and --web FOLDER")
        if self.index is not None and (self.out is None or not self.text):
            raise UserError("--index lists the Gaussians that match: give --text and --out with it")
        if self.out is not None:
            make_folder(self.out.parent)
            check_splat_name(self.out)
            if len(self.text) > 1:
                raise UserError("a splat file is of one --text: write several files, or a page (--web)")
        scene = load_scene(self.run, settings=self.settings)
        if self.web is not None:
            size = write_page(scene, self.web, self.text, self.title, self.credit, self.look)
            say(f"Wrote {size / 1e6:.1f} MB to {self.web}; see it: python -m http.server -d {self.web}")
        if self.out is not None:
            text = self.text[0] if self.text else None
            count = scene.export(self.out, text, everything=self.all, look=self.look, index=self.index)
            say(f"Wrote {count} of {len(scene.gaussians['means'])} Gaussians to {self.out}")
