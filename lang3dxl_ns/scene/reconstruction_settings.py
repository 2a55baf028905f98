"""Settings of a reconstruction, in a module of their own so that a command's help needs no numpy or torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass
class ReconstructionSettings:
    """Settings of a reconstruction. If they change, it starts anew."""

    mapper: Literal["incremental", "global"] = "incremental"
    """COLMAP's mapper: incremental, or global (GLOMAP), which is meant for many photos."""
    max_size: int = 1600
    """Longer side in pixels at which features are detected; larger photos are shrunk."""
    features: int = 4096
    """Maximum number of features per photo."""
    one_camera: bool | None = None
    """Whether one camera with one lens took all photos. By default, EXIF and sizes decide."""
