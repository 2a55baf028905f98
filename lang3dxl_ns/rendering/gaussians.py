"""What goes into a rendering and what comes out: Gaussians, a camera, the rendered maps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

MAX_LOG_SCALE = 60.0
"""Clamp logarithms of scales to this before `exp`: an infinite scale has the gradient 0 · ∞ = NaN."""


@dataclass
class Gaussians:
    """Gaussians in the world frame, with activated values (no logarithms, no logits)."""

    means: Float[Tensor, "n 3"]
    """Centres, world units."""
    quats: Float[Tensor, "n 4"]
    """Rotations as quaternions (w, x, y, z) of any length; zero length counts as no rotation."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the rotated axes, world units, positive."""
    opacities: Float[Tensor, " n"]
    """Peak opacity, 0…1."""

    def detach(self) -> Gaussians:
        """The same Gaussians, cut off from the gradient."""
        return Gaussians(
            self.means.detach(), self.quats.detach(), self.scales.detach(), self.opacities.detach()
        )

    def moved(self, by: Float[Tensor, "3"]) -> Gaussians:
        """The same Gaussians, their centres shifted."""
        return Gaussians(self.means + by, self.quats, self.scales, self.opacities)

    def without_broken(self) -> Gaussians:
        """Those with a NaN or infinite value become transparent and get no gradient; the rest stay."""
        with torch.no_grad():
            total = self.means.sum(1) + self.quats.sum(1) + self.scales.sum(1) + self.opacities
            sound = torch.isfinite(total)
        if bool(sound.all()):
            return self
        return Gaussians(
            torch.where(sound[:, None], self.means, 0.0),
            torch.where(sound[:, None], self.quats, 0.0),
            torch.where(sound[:, None], self.scales, 0.0),
            torch.where(sound, self.opacities, 0.0),
        )


@dataclass
class Camera:
    """A pinhole camera without distortion and skew; OpenCV axes (x right, y down, z forward)."""

    view_matrix: Float[Tensor, "4 4"]
    """World to camera, rigid, world units."""
    intrinsics: Float[Tensor, "3 3"]
    """Pixels; origin at the top-left corner of the top-left pixel, so pixel centres lie at +0.5."""
    width: int
    height: int

    def at_origin(self, like: Tensor) -> tuple[Camera, Float[Tensor, "3"]]:
        """The camera in a world whose origin is the camera's own place (rounded), and that place.

        Far from the origin (map coordinates are millions) R·x + t is a small difference of large numbers.
        R·(x − place) + (R·place + t) is the same without them, if the bracket that belongs to the camera is
        computed in float64. Type and device are those of `like`.
        """
        view = self.view_matrix.to(like.device, torch.float64)
        place = -(view[:3, :3].T @ view[:3, 3]).detach().to(like.dtype)
        shift = torch.eye(4).to(view)
        shift[:3, 3] = place
        return Camera((view @ shift).to(like.dtype), self.intrinsics, self.width, self.height), place


@dataclass
class Rendering:
    """The maps that one rasterisation makes."""

    image: Float[Tensor, "h w c"]
    """The channels over the background."""
    features: Float[Tensor, "h w d"] | None
    """The features over black, not divided by alpha."""
    alpha: Float[Tensor, "h w 1"]
    """Accumulated opacity, 0…1."""
    depth: Float[Tensor, "h w 1"] | None
    """Expected distance along the camera's z axis, world units; 0 where alpha is 0."""
    info: dict[str, Any] = field(default_factory=dict)
    """What gsplat's densification strategies read: image size, screen positions and radii."""
