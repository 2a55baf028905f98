"""Words for splats of other programs: frames, views, and learning without a trainer."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.settings import PreparationConfig

Up = Literal["auto", "x", "-x", "y", "-y", "z", "-z"]


@dataclass(kw_only=True)
class AttachConfig(PreparationConfig):
    """Settings of `attach`: those of its views and words, and of encoders, crops and foreground."""

    views: int = 48
    """Number of views of the splat to render and learn from, without photos."""
    up: Up = "auto"
    """Axis of the splat that points up, without photos. With auto, it is estimated from the ground."""
    segment: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Word that the foreground model finds in the photos and teaches the scene. Repeat the flag for more."""
    cache_dir: Path | None = None
    """Folder for the prepared targets (default: lang3dxl_cache inside the photos' folder)."""

    def check(self) -> None:
        """Raise UserError if a setting is invalid."""
        super().check()
        check_numbers(self, {"views": (4, 1000)})
        if self.crops == "pyramid" or self.regions not in ("auto", "none"):
            raise UserError("attach learns from fine crops alone: leave --crops and --regions off")
