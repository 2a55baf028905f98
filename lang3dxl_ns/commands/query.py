"""`lang3dxl query` and `lang3dxl export`: text queries from the shell."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import make_folder, slugs, write_atomically
from lang3dxl_ns.common.reports import progress_bar
from lang3dxl_ns.query.doubt import doubtful
from lang3dxl_ns.query.heat_maps import overlay
from lang3dxl_ns.query.run_file import read_camera_path
from lang3dxl_ns.query.scene import Match, QueryConfig, Scene
from lang3dxl_ns.query.splat_file import write_splats
from lang3dxl_ns.scene.camera import Camera


@dataclass(kw_only=True)
class Query:
    """Search a trained scene for texts: writes heat maps, masks and relevancy maps.

    For every text, a folder in --out with, for every view, `….overlay.png` (heat map over the rendering),
    `….mask.png` and `….npy` (relevancy, float32); `query.json` lists prompts and results. Without
    --image, --all or --camera-path, the training view that shows the first text best is used.
    """

    load_config: Path
    """config.yml of the run."""
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
        scene = load_scene(self.load_config, settings=self.settings)
        prompts = scene.prompts(self.text)
        folders = [self.out / slug for slug in slugs([prompt.text for prompt in prompts])]
        places = dict(self._places(scene))
        views = []
        with progress_bar() as bar:
            for name, place in bar.track(places.items(), description="rendering"):
                matches = scene.match(prompts, place)
                for folder, match in zip(folders, matches, strict=True):
                    write_match(match, folder / name, self.settings.threshold)
                views.append(_view_report(name, matches))
        report = {
            "threshold": self.settings.threshold,
            "texts": [_text_report(m, f) for m, f in zip(matches, folders, strict=True)],
            "views": views,
        }
        write_atomically(self.out / "query.json", json.dumps(report, indent=2, ensure_ascii=False) + "\n")
        for i, prompt in enumerate(prompts):
            best = max(views, key=lambda view: view["matches"][i]["score"])
            found = best["matches"][i]
            where = f"at pixel {found['peak'][0]}, {found['peak'][1]} of {best['view']}"
            print(f"{prompt.text}: {found['score']:.2f} {where}; {folders[i]}")
            if advice := doubtful(prompt.text, matches[i].doubt):
                print(f"  {advice}")

    def _places(self, scene: Scene) -> Iterator[tuple[str, Camera | str]]:
        """File name (no suffix) of every requested view, and its camera or photo."""
        if self.camera_path is not None:
            yield from ((f"{i:05d}", c) for i, c in enumerate(read_camera_path(self.camera_path)))
        elif self.all:
            names = file_names([photo.name for photo in scene.file.photos])
            yield from zip(names, (photo.name for photo in scene.file.photos), strict=True)
        else:
            name = scene.file.photo(self.image).name if self.image else _best_view(scene, self.text)
            yield file_names([name])[0], name


def _best_view(scene: Scene, texts: list[str]) -> str:
    found = scene.find(texts)[0]
    if found.viewpoints:
        return found.viewpoints[0].name
    print(f"no training view shows {found.prompt.text!r}: using the first one")
    return scene.file.photos[0].name


def file_names(photos: list[str]) -> list[str]:
    """A unique file name (no suffix) for each photo: a.jpg beside a.png becomes a_jpg."""
    stems = [str(PurePosixPath(photo).with_suffix("")).replace("/", "_") for photo in photos]
    whole = [photo.replace("/", "_").replace(".", "_") for photo in photos]
    names = [stem if stems.count(stem) == 1 else name for stem, name in zip(stems, whole, strict=True)]
    return [n if names.count(n) == 1 else f"{n}-{i + 1}" for i, n in enumerate(names)]


def write_match(match: Match, stem: Path, threshold: float) -> None:
    """Write `stem`.overlay.png, .mask.png and .npy."""
    picture = overlay(match.view.image, match.relevancy, threshold)
    _save_png(picture, stem.with_name(f"{stem.name}.overlay.png"))
    _save_png(match.mask.float(), stem.with_name(f"{stem.name}.mask.png"))
    content = io.BytesIO()
    np.save(content, match.relevancy.cpu().numpy().astype(np.float32))
    write_atomically(stem.with_name(f"{stem.name}.npy"), content.getvalue())


def _save_png(pixels: Float[Tensor, "h w ..."], path: Path) -> None:
    content = io.BytesIO()
    Image.fromarray((pixels.clamp(0, 1) * 255).round().byte().cpu().numpy()).save(content, "PNG")
    write_atomically(path, content.getvalue())


def _text_report(match: Match, folder: Path) -> dict:
    return {
        "text": match.prompt.text,
        "negatives": list(match.prompt.negatives),
        "synonyms": match.synonyms,
        "doubt": match.doubt,
        "folder": folder.name,
    }


def _view_report(name: str, matches: list[Match]) -> dict:
    found = [{"peak": m.peak, "score": m.score, "area": float(m.mask.float().mean())} for m in matches]
    seconds = {"render_seconds": matches[0].view.seconds, "query_seconds": matches[0].seconds}
    return {"view": name, **seconds, "matches": found}


@dataclass(kw_only=True)
class Export:
    """Write the Gaussians that match a text to a PLY file that ordinary splat viewers open.

    In the model's frame.
    """

    load_config: Path
    """config.yml of the run."""
    text: str
    """One prompt to look for."""
    out: Path
    """The .ply file to write."""
    all: bool = False
    """Write all Gaussians, each with its relevancy as a property `score` (0…1)."""
    settings: Annotated[QueryConfig, tyro.conf.arg(name="")] = field(default_factory=QueryConfig)

    def main(self) -> None:
        from lang3dxl_ns.plugin.load_scene import load_scene

        make_folder(self.out.parent)
        if self.out.is_dir():
            raise UserError(f"--out {self.out} is a folder: name the .ply file")
        scene = load_scene(self.load_config, settings=self.settings)
        scores = scene.query_gaussians(self.text)
        matching = scores > self.settings.threshold
        if not self.all and not matching.any():
            raise UserError(
                f"no Gaussian matches {self.text!r}: the best reaches {float(scores.max()):.2f}; lower "
                f"--threshold, now {self.settings.threshold}, or write all with their scores (--all)"
            )
        keep, extra = (None, scores) if self.all else (matching, None)
        count = write_splats(self.out, scene.gaussians, keep, extra)
        print(f"Wrote {count} of {len(scores)} Gaussians to {self.out}")
