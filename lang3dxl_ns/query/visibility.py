"""Visible Gaussians per view and their sizes, for ranking views without rendering them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.query.cache import load_tensors, save_tensors
from lang3dxl_ns.scene.camera import Camera

_LEAST = 1e-3
"""Pixels below which a Gaussian counts as not visible in a view."""


@dataclass(frozen=True)
class VisibleGaussians:
    """The Gaussians visible in one view."""

    camera: Camera
    rows: Int[Tensor, " m"]
    """Indices of the visible Gaussians."""
    shares: Float[Tensor, " m"]
    """Share of the view that each of these Gaussians fills."""

    @classmethod
    def of(cls, camera: Camera, mass: Float[Tensor, " n"]) -> VisibleGaussians:
        """Build an instance from the pixels that every Gaussian fills."""
        rows = (mass > _LEAST).nonzero().squeeze(1)
        return cls(camera, rows.int(), (mass[rows] / (camera.width * camera.height)).float())

    @property
    def pixels(self) -> Float[Tensor, " m"]:
        """Pixels that each of these Gaussians fills."""
        return self.shares * self.size

    @property
    def size(self) -> int:
        """Number of pixels in the view."""
        return self.camera.width * self.camera.height

    def distance(self, means: Float[Tensor, "n 3"]) -> float:
        """Compute the median depth of the visible Gaussians in world units; NaN if there are none."""
        view = self.camera.view_matrix.to(means)
        depths = means[self.rows] @ view[2, :3] + view[2, 3]
        return float(depths.median()) if len(depths) else float("nan")


def save_visible(path: Path, views: Mapping[str, VisibleGaussians], key: str) -> None:
    """Write the views, with one concatenated tensor per field."""
    parts = {
        "rows": torch.cat([view.rows for view in views.values()]),
        "shares": torch.cat([view.shares for view in views.values()]),
    }
    save_tensors(path, parts, key, [len(view.rows) for view in views.values()])


def load_visible(
    path: Path, key: str, cameras: Mapping[str, Camera], device: torch.device | str
) -> dict[str, VisibleGaussians] | None:
    """Load the views cached under this key, which covers names and cameras; None if there are none."""
    found = load_tensors(path, key)
    if found is None or "shares" not in found[0]:  # written by an earlier version
        return None
    tensors, sizes = found
    rows, shares = (tensors[name].to(device).split(sizes) for name in ("rows", "shares"))  # type: ignore[arg-type]
    named = zip(cameras.items(), rows, shares, strict=True)
    return {name: VisibleGaussians(camera, r, p) for (name, camera), r, p in named}
