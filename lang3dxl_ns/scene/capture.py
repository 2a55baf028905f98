"""Capture: a folder's photos with cameras, masks, points, split and frame, for training and for `attach`.

A capture comes from a COLMAP model, a transforms.json, a folder of photos alone, or a video.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray as Array

from lang3dxl_ns.scene.colmap import Reconstruction
from lang3dxl_ns.scene.frame import Center, Frame, Orientation
from lang3dxl_ns.scene.photo import Photo


class Split(NamedTuple):
    """Names of the photos to train on, and of those held out. Under "all", both name every photo."""

    train: tuple[str, ...]
    held_out: tuple[str, ...]


@dataclass
class CaptureSettings:
    """Where a capture's parts are, and how it is split and normalized."""

    colmap_path: Path | None = None
    """Folder of the COLMAP model, relative to the capture's; None: the first of the usual places."""
    images_path: Path = Path("images")
    """Folder of the model's photos, relative to the capture's; where it has none, the photos are found."""
    masks_path: Path | None = Path("masks")
    """Folder of foreground masks; None: none are used."""
    held_out: Path | None = None
    """Text file with names of the photos to hold out."""
    follow_links: bool = False
    """Whether photos and masks may be symbolic links that leave their folder."""
    eval_mode: Literal["fraction", "filename", "interval", "all"] = "interval"
    train_split_fraction: float = 0.9
    eval_interval: int = 8
    orientation_method: Orientation = "up"
    center_method: Center = "poses"
    auto_scale_poses: bool = True
    scale_factor: float = 1.0


@dataclass(frozen=True, eq=False)
class Capture:
    """Photos on disk with their cameras and points, in the coordinates of the file that they come from."""

    folder: Path
    """Folder of the capture."""
    photos: list[Photo]
    """Usable photos with their masks, sorted by name."""
    reconstruction: Reconstruction
    """Poses of these photos, tracks, and points with colors."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Photos that can't be used, with reasons."""
    source: Path | None = None
    """COLMAP model or transforms.json that it was read from."""
    settings: CaptureSettings = field(default_factory=CaptureSettings)

    @cached_property
    def split(self) -> Split:
        """Photos to train on and photos held out."""
        raise NotImplementedError

    @cached_property
    def frame(self) -> Frame:
        """Similarity from the file's coordinates to training's."""
        raise NotImplementedError

    @property
    def recorded_frame(self) -> Frame:
        """Similarity from the original coordinates, before those that a transforms.json has applied."""
        return self.frame

    def poses(self, names: Sequence[str]) -> Float32[Array, "n 3 4"]:
        """Compute photos' poses in training's frame (camera → world; x right, y up, z backward)."""
        raise NotImplementedError

    @property
    def seeds(self) -> tuple[Float32[Array, "m 3"], UInt8[Array, "m 3"]]:
        """Points in training's frame, and their colors."""
        raise NotImplementedError


def open_capture(
    data: str | Path,
    settings: CaptureSettings | None = None,
    cache_dir: Path | None = None,
    may_reconstruct: bool = True,
) -> Capture:
    """Open the capture in a folder: with a COLMAP model, a transforms.json, or photos (or a video) alone,
    which are reconstructed. Raises UserError if there are no photos, or none can be used, or the file with
    their cameras is damaged."""
    raise NotImplementedError
