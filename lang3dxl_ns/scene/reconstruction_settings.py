"""Settings of a reconstruction, in their own module so that a command's help needs no numpy or torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass
class ReconstructionSettings:
    """Settings of a reconstruction; changed settings start it anew."""

    mapper: Literal["incremental", "global"] = "incremental"
    """COLMAP's mapper: incremental, or global (GLOMAP), which is meant for many photos."""
    max_size: int = 1600
    """Longer side in pixels for feature detection."""
    features: int = 4096
    """Most features per photo."""
    one_camera: bool | None = None
    """Whether one camera with one lens took all photos; by default decided by EXIF and sizes."""
