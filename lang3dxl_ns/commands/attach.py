"""`lang3dxl attach`: words for a splat that any program made."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from lang3dxl_ns.attachment import AttachConfig
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing

if TYPE_CHECKING:
    from lang3dxl_ns.query.scene import Scene
    from lang3dxl_ns.query.text import Prompt


@showing("splat", "data", "out", "text", "clip", "up", "foreground", "segment")
@dataclass(kw_only=True)
class Attach(AttachConfig):
    """Give words to a finished splat: write a scene that answers any text, without training colors again.

    Reads PLY files of any program (also SuperSplat's compressed ones), .spz, .sog, .glb, .splat, gsplat's
    checkpoints, and runs of nerfstudio's splatfacto. With --data, words are learned from the splat's photos.
    Without it, they are learned from views of the splat itself, which is less accurate.
    """

    splat: tyro.conf.Positional[Path]
    """File of the splat, or the folder of its run."""
    data: Path | None = None
    """Photos of the splat, with a COLMAP model, with a transforms.json, or alone, or a video."""
    out: Path
    """Scene file to write, NAME.scene."""
    text: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Texts to search for at the end ("windows; towers"), with a picture of the best view of each."""

    def main(self) -> None:
        from lang3dxl_ns.attachment.attach import attach
        from lang3dxl_ns.query.text import parse_prompts

        self.check()
        if self.data is not None and (self.views, self.up) != (AttachConfig.views, AttachConfig.up):
            raise UserError("--views and --up choose views of the splat, without --data: leave them off")
        prompts = [prompt for text in self.text for prompt in parse_prompts(text)]  # fail before the work
        scene = attach(self.splat, self.data, self.out, self)
        if prompts:
            _show(scene, prompts, self.out)
        say(f'Ask it: lang3dxl query {shlex.quote(str(self.out))} --text "windows" --out found')


def _show(scene: Scene, texts: Sequence[str | Prompt], out: Path) -> None:
    """Write a picture of the view that shows each text best, named after the text."""
    from lang3dxl_ns.common.files import slugs
    from lang3dxl_ns.query.doubt import doubtful

    matches = scene.query(texts)
    for match, slug in zip(matches, slugs([match.prompt.text for match in matches]), strict=True):
        picture = match.save(out.with_name(f"{out.stem}.{slug}.png"))
        say(f"{match.prompt.text}, in the view of {match.view.name}: {picture}")
        if advice := doubtful(match.prompt.text, match.doubt, match.prompt.taught is not None):
            say(f"  {advice}")
