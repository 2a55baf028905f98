"""`lang3dxl demo-scene`, apart from the generator so that its help starts fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.settings_help import showing

FOLDER, CAMERAS = "test_views", "cameras.json"
"""Folder of a scene's test views, and the file in it that lists their cameras."""


@showing("out", "seed", "family")
@dataclass
class DemoScene:
    """Generate a demo scene: photos of a procedural landmark."""

    out: Path
    """Folder to write to. It must be empty or missing."""
    seed: int = 0
    """Seed of the random choices. The same seed gives the same bytes."""
    family: Literal["cathedral", "mosque", "hall", "auto"] = "auto"
    """Kind of building. With auto, the seed chooses it."""
    photos: int = 48
    """Number of photos, 4 to 9999."""
    wild: bool = True
    """Vary sizes, lenses, weather, exposures and passers-by as in photos from the Internet. --no-wild uses
    one camera, one sun and no people."""
    weathered: bool = False
    """Give walls and windows stains and grain of their own, as real ones have, to try reconstruction. The
    built-in encoders know landmarks without them."""
    width: int = 480
    """Width of a landscape photo, pixels. Wild photos are smaller."""
    height: int = 360
    """Height of a landscape photo, pixels."""
    test_views: int = 24
    """Number of novel views for scoring (test_views/), with cameras like the photos', plain lighting and no
    people. 0 makes none."""
    workers: int | None = None
    """Number of processes. The default is one per CPU core."""

    def main(self) -> None:
        from lab.landmark.scene_writer import write_scene

        folder = write_scene(self)
        say(f"{self.photos} photos, COLMAP model, masks and ground truth in {folder}")
