"""Settings of a demo scene, separate from the work so that the help of `lang3dxl demo-scene` starts fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass
class DemoScene:
    """Generate a demo scene: photos of a procedural landmark."""

    out: Path
    """Folder to write; must be empty or missing."""
    seed: int = 0
    """The same seed gives the same bytes."""
    family: Literal["cathedral", "mosque", "hall", "auto"] = "auto"
    """Kind of building; auto: chosen by the seed."""
    photos: int = 48
    """Number of photos, 4 to 9999."""
    wild: bool = True
    """Like photos from the Internet: sizes, lenses, weather, exposures and passers-by vary. --no-wild:
    one camera, one sun, no people."""
    width: int = 480
    """Pixels of a landscape photo; wild photos are smaller."""
    height: int = 360
    """Pixels of a landscape photo."""
    test_views: int = 24
    """Novel views for scoring (test_views/): cameras like the photos', plain light, no people. 0: none."""
    workers: int | None = None
    """Number of processes; by default one per CPU core."""
