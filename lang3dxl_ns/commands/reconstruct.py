"""`lang3dxl reconstruct`: COLMAP model from a folder of photos, or a video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lang3dxl_ns.common.console import say
from lang3dxl_ns.scene.reconstruction import ReconstructionSettings


@dataclass(kw_only=True)
class Reconstruct(ReconstructionSettings):
    """Reconstruct photos: cameras, poses and points, as a COLMAP model.

    `ns-train lang3dxl` does this itself for photos without a model; this command does it in advance. It can
    be interrupted and repeated at any time, and never replaces an existing model.
    """

    data: Path
    """Folder of photos (in it, in images/, or in sub-folders), or a video."""
    cache_dir: Path | None = None
    """Folder for features and matches (default: lang3dxl_cache inside the data folder)."""

    def main(self) -> None:
        from lang3dxl_ns.scene.reconstruct import reconstruct_scene

        data, model = reconstruct_scene(self.data, self.cache_dir, self)
        say(f"The model is in {model}. Train with: ns-train lang3dxl --data {data}")
