"""`lang3dxl view` and `lang3dxl info`: a scene in the browser, and what its file holds."""

from __future__ import annotations

import contextlib
import os
import sys
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from lang3dxl_ns.commands.of_scene import OfScene
from lang3dxl_ns.common.checks import check_address
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing


@showing("scene", "text", "photos", "tour", "host", "port", "browser")
@dataclass(kw_only=True)
class View(OfScene):
    """Explore and query a scene in a browser.

    The browser draws the Gaussians (WebGL) and answers words; this machine encodes texts. The page is the one
    of `lang3dxl export --web`, which answers the words of a vocabulary without any server.
    """

    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Prompt to start with. Repeat the flag, or separate prompts with `;`."""
    photos: Path | None = None
    """Folder of the scene's photos, to be shown over the rendering (default: the run's, if it is there)."""
    host: str = "127.0.0.1"
    """Address to serve at. 0.0.0.0 opens it to the network, with the token shown in the terminal."""
    port: int | None = None
    """Port to serve at. The default is a free one from 7007 on."""
    tour: bool = False
    """Play the tour that the page kept in the scene's file (Tour, Keep this view)."""
    browser: bool = True
    """Open the page in a browser, on a machine with a desktop (--no-browser: only print the address)."""

    def main(self) -> None:
        from lang3dxl_ns.open_scene import find_scene_file, load_scene, provenance_of
        from lang3dxl_ns.scene.photo_folder import find_photos
        from lang3dxl_ns.web.photos import folder_of_run
        from lang3dxl_ns.web.serve import PageServer
        from lang3dxl_ns.web.teach import PageWords
        from lang3dxl_ns.web.write_page import Page

        check_address(self.host, self.port)  # fail now rather than after the work
        if self.photos is not None:
            find_photos(self.photos)
        if self.tour and self.text:
            raise UserError("--tour shows the words of its stops, in place of --text: leave one off")
        file, told = find_scene_file(self.scene), provenance_of(self.scene)
        if self.tour and not told.tour:
            raise UserError("the scene's file has no tour: keep views in the page (Tour, Keep this view)")
        scene, photos = load_scene(self.scene, clip=self.clip), self.photos or folder_of_run(file)
        page = Page(scene, self.text, provenance=told, photos=photos, live=True, own_words=PageWords(file))
        server = PageServer(page, self.host, self.port)
        who = "anyone with this address" if server.access.needs_token else "this machine only"
        address = server.access.address + "#play=1" * self.tour
        say(f"Open {address} ({who}). Ctrl-C ends it.")
        if elsewhere := server.access.elsewhere:
            say(f"From other machines: {elsewhere}")
        if self.browser and _has_display():
            webbrowser.open(address)
        with contextlib.suppress(KeyboardInterrupt), server:
            server.serve_forever()


def _has_display() -> bool:
    """Return whether somebody sits at this machine, in front of a desktop."""
    desktop = sys.platform in ("darwin", "win32") or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
    return bool(desktop) and sys.stdout.isatty() and "SSH_CONNECTION" not in os.environ


@showing("scene")
@dataclass(kw_only=True)
class Info:
    """Print what a scene file holds and where it comes from."""

    scene: tyro.conf.Positional[Path | None] = None
    """A .scene file, or a folder that holds one (default: the newest run under outputs/)."""

    def main(self) -> None:
        from lang3dxl_ns.files.scene_file import describe_scene_file
        from lang3dxl_ns.open_scene import existing_scene_file
        from lang3dxl_ns.query.text import why_no_words

        told = describe_scene_file(existing_scene_file(self.scene))
        decoder, count = told["decoder"], told["gaussians"]
        words = f"CLIP {told['clip']}, decoder {decoder['name']}" if decoder else why_no_words(told["scene"])
        lines = {name.replace("_", " "): value for name, value in vars(told["provenance"]).items()} | {
            "Gaussians": f"{count:,}",
            "photos": f"{told['photos']}{', each with its lighting' if told['looks'] else ''}",
            "words": words,
            "meters": told["scene"].georeference,
            "tour": f"{stops} stops" if (stops := told["provenance"].tour.count("stop=")) else "",
            "size": f"{told['bytes'] / 1e6:.2f} MB, {told['bytes'] / max(count, 1):.0f} bytes a Gaussian",
        }
        say(*(f"{name:10} {' '.join(str(value).split())}" for name, value in lines.items() if value))
