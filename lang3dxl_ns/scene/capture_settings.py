"""Settings of a capture; a command's help needs no numpy or torch for them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

CAPTURE_BOUNDS = {"eval_interval": (2, 1e9), "scale_factor": (1e-9, 1e9)}
"""Ranges of a capture's numbers: every photo can't be held out, and a scene has a size."""
Orientation = Literal["up", "vertical", "none"]
Center = Literal["poses", "none"]


@dataclass
class CaptureSettings:
    """Where a capture's parts are, and how it is split and normalized."""

    colmap_path: Path | None = None
    """COLMAP model, relative to the data folder (default: sparse/0, sparse, colmap/sparse/0 or
    dense/sparse)."""
    images_path: Path = Path("images")
    """Folder of the photos, relative to the data folder; dense/images is tried too."""
    masks_path: Path | None = Path("masks")
    """Folder of foreground masks, relative to the data folder, named like the photos (.png or .jpg); white
    marks what to keep. A photo without a mask is used whole. `foreground` has other sources."""
    held_out: Path | None = None
    """Text file with names of the photos to hold out of training, one per line, with or without suffix, in
    place of every eighth photo. `lang3dxl evaluate split` makes one from ground truth."""
    follow_links: bool = False
    """Whether photos and masks may be symbolic links that leave their folder."""
    eval_mode: Literal["interval", "all"] = "interval"
    """Rule for the held-out photos: every `eval_interval`-th one in the order of names, or none."""
    eval_interval: int = 8
    """Number of photos of which one is held out."""
    orientation_method: Orientation = "up"
    """Direction that becomes z in training. up: the mean of the cameras' up axes. vertical: what is
    orthogonal to their right axes. none: the capture's own."""
    center_method: Center = "poses"
    """Origin in training: the mean of the cameras (poses), or the capture's own (none)."""
    auto_scale_poses: bool = True
    """Whether the farthest coordinate of a camera becomes 1 in training."""
    scale_factor: float = 1.0
    """Scale of the training frame in addition."""
