"""`lang3dxl export`: a scene, or what matches a text, in another form."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from lang3dxl_ns.commands.of_scene import OfScene
from lang3dxl_ns.commands.query import Negatives, parse_texts
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import make_folder, read_names
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.files.scene_file import Provenance, check_scene_name, replace_scene
from lang3dxl_ns.files.splat_file import check_splat_name
from lang3dxl_ns.open_scene import load_scene, provenance_of
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.query.vocabulary import whole_words
from lang3dxl_ns.scene.photo_folder import find_photos
from lang3dxl_ns.web.video import RATE, tour_shots, write_video
from lang3dxl_ns.web.write_page import Page, write_page

_READ_BY: dict[str, tuple[str, ...]] = dict.fromkeys(("title", "credit", "license"), ("web", "scene_file"))
_READ_BY |= dict.fromkeys(("text", "not_", "look"), ("out", "web"))
_READ_BY |= {"vocabulary": ("web",), "photos": ("web",), "all": ("out",), "hide_floaters": ("out",)}
_READ_BY |= {"things": ("video",)}
"""Targets of `export` that read an option. Options that are not listed are read by every target."""


@showing("scene", "text", "not_", "out", "web", "scene_file", "video", "title", "all", "look", "settings")
@dataclass(kw_only=True)
class Export(OfScene):
    """Write a scene in another form. --out writes a splat file of the Gaussians that match a text, in the
    model's frame, which ordinary viewers open. --web writes a web page that answers words by itself.
    --scene-file writes the scene itself to one file, which can be queried without its run and photos."""

    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Text to search for (default: write everything). With --web, prompts that the page opens with."""
    not_: Negatives = field(default_factory=list)
    """Negative for all texts. Repeat the flag for more."""
    out: Path | None = None
    """Splat file to write, .ply, .spz, .sog or .glb."""
    web: Path | None = None
    """Folder for a web page that any static server can serve."""
    video: Path | None = None
    """Video to write, such as out.mp4, of the tour that the page kept in the scene's file (needs ffmpeg)."""
    things: bool = False
    """With --video: draw numbered boxes of the things that the tour's words name, in place of heat."""
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
    settings: Annotated[QueryConfig, tyro.conf.arg(name="")] = field(default_factory=QueryConfig)

    def main(self) -> None:
        target = self._target()
        prompts = parse_texts(self.text, self.not_)
        if self.photos is not None:
            find_photos(self.photos)  # fail now rather than after the work
        if self.scene_file is not None:
            check_scene_name(self.scene_file)
        if self.out is not None:
            make_folder(self.out.parent)
            check_splat_name(self.out)
            if len(prompts) > 1:
                raise UserError("a splat file holds one --text: write several files, or a page (--web)")
        scene = load_scene(self.scene, settings=self.settings, clip=self.clip)
        write = {"out": self._splat, "web": self._page, "scene_file": self._scene, "video": self._video}
        prompts = parse_texts(self.text, self.not_, scene.words)
        write[target](getattr(self, target), scene, prompts)

    def _target(self) -> str:
        """Return which file is written. Raises UserError unless it is one, and for options without effect."""
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
        if self.all and self.text and self.index is None and self.out and self.out.suffix.lower() != ".ply":
            raise UserError(
                f"{self.out.name} can't hold relevancies: write a .ply, or leave --text or --all off"
            )
        if self.settings != QueryConfig() and not self.text and targets[0] in ("out", "scene_file"):
            give = ", or give one" * (targets[0] in _READ_BY["text"])
            raise UserError(f"settings of queries have no effect without --text: leave them off{give}")
        if self.settings.size is not None:
            raise UserError("--size is that of pictures, of which export writes none: leave it off")
        return targets[0]

    def _splat(self, path: Path, scene: Scene, prompts: list[Prompt]) -> None:
        text = prompts[0] if prompts else None
        which = {"everything": self.all, "hide_floaters": self.hide_floaters}
        count = scene.export(path, text, look=self.look, index=self.index, **which)
        say(f"Wrote {count} of {len(scene.splats)} Gaussians to {path}")

    def _page(self, folder: Path, scene: Scene, prompts: list[Prompt]) -> None:
        own = read_names(self.vocabulary, "words") if self.vocabulary else ()
        words = self._clip_words(scene.file.clip)
        page = Page(scene, prompts, own, words, self._told(), self.look, self.photos)
        size = write_page(page, folder)
        say(*(f"{left_out}." for left_out in page.left_out))
        see = f"python -m http.server -d {shlex.quote(str(folder))}"
        say(f"Wrote {size / 1e6:.1f} MB to {folder}; see it: {see}")

    def _scene(self, path: Path, scene: Scene, _: list[Prompt]) -> None:
        _kept, size = replace_scene(path, scene, self._told())
        ask = f"lang3dxl query {shlex.quote(str(path))}"
        say(f"Wrote {size / 1e6:.1f} MB to {path}; ask it: {ask}")

    def _video(self, path: Path, scene: Scene, _: list[Prompt]) -> None:
        count = write_video(path, scene, tour_shots(scene, self._told().tour), self.things)
        say(f"Wrote {count} pictures, {count / RATE:.0f} seconds, to {path}")

    def _clip_words(self, clip: str | None) -> tuple[str, ...]:
        """Return the words of the CLIP's tokenizer; empty on a machine without that CLIP."""
        if (name := self.clip or clip) is None:  # a scene of colors alone
            return ()
        try:
            return whole_words(name)
        except UserError as error:
            say(f"The page knows only the shipped words: {error}")
            return ()

    def _told(self) -> Provenance:
        """Return the provenance in the scene's own file, with what the flags override."""
        flags = {"title": self.title, "credit": self.credit, "license": self.license}
        told = {name: text for name, text in flags.items() if text}
        return replace(provenance_of(self.scene), made_by=Provenance.made_by, **told)
