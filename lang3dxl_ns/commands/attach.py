"""`lang3dxl attach`: words for a splat that any program made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from lang3dxl_ns.attachment import AttachConfig
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.settings_help import showing


@showing(
    *("splat", "data", "out", "clip", "quality", "views", "up", "foreground", "segment", "workers"),
    "cache_dir",
)
@dataclass(kw_only=True)
class Attach(AttachConfig):
    """Give words to a finished splat: write a scene that answers any text, without training colors again.

    Reads PLY files of any program (also SuperSplat's compressed ones), .spz, .splat, gsplat's checkpoints,
    and runs of nerfstudio's splatfacto. With --data, words are learned from the splat's photos. Without it,
    they are learned from views of the splat itself, which is less accurate.
    """

    splat: tyro.conf.Positional[Path]
    """File of the splat, or the folder of its run."""
    data: Path | None = None
    """Photos of the splat, with a COLMAP model, with a transforms.json, or alone, or a video."""
    out: Path
    """Scene file to write, NAME.scene."""

    def main(self) -> None:
        from lang3dxl_ns.attachment.attach import attach

        self.check()
        attach(self.splat, self.data, self.out, self)
        say(f'Ask it: lang3dxl query {self.out} --text "windows" --out found')
