"""Settings that every command about a scene has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(kw_only=True)
class OfScene:
    """Settings of every command about a scene."""

    scene: tyro.conf.Positional[Path | None] = None
    """A .scene file, a folder that holds one, or a run (default: the newest run under outputs/)."""
    clip: str | None = None
    """Name or folder of the scene's CLIP, if it is not where the scene file says."""
