"""Inputs and outputs of `rasterize`: Gaussians and rendered maps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.scene.camera import Camera

MAX_LOG_SCALE = 60.0
"""Upper limit of log scales before `exp`. An infinite scale has the gradient 0 · ∞ = NaN."""
CLOSEST = 1.5
"""Depth from which Gaussians are visible, in standard deviations of their longest axis. They are fully
visible from twice this depth."""


@dataclass
class Gaussians:
    """Gaussians in the world frame, with activated values (no logarithms, no logits)."""

    means: Float[Tensor, "n 3"]
    """Centers, world units."""
    quats: Float[Tensor, "n 4"]
    """Rotations as quaternions (w, x, y, z) of any length; zero length means no rotation."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the rotated axes, world units, positive."""
    opacities: Float[Tensor, " n"]
    """Peak opacity, 0…1."""

    def detach(self) -> Gaussians:
        """Return the same Gaussians without gradient."""
        return Gaussians(
            self.means.detach(), self.quats.detach(), self.scales.detach(), self.opacities.detach()
        )

    def seen_from(self, camera: Camera) -> Gaussians:
        """Return the same Gaussians, but transparent where their depth is small relative to their length.

        A splat's affine approximation holds only where a Gaussian is small for its depth. Without this, a
        Gaussian as small as a finger beside the picture would cover it when the camera is close to a wall.
        """
        with torch.no_grad():
            moved, place = camera.at_origin(self.means)
            depth = (self.means - place) @ moved.view_matrix[2, :3] + moved.view_matrix[2, 3]
            shown = (depth / (CLOSEST * self.scales.amax(1)).clamp_min(1e-30) - 1).clamp(0.0, 1.0)
        return replace(self, opacities=self.opacities * shown)

    def moved(self, by: Float[Tensor, "3"]) -> Gaussians:
        """Return the same Gaussians with shifted centers."""
        return Gaussians(self.means + by, self.quats, self.scales, self.opacities)


@dataclass
class Raster:
    """Maps of one rasterization, as training needs them."""

    image: Float[Tensor, "h w c"]
    """Channels composited over the background."""
    features: Float[Tensor, "h w d"] | None
    """Features composited over black, not divided by alpha."""
    alpha: Float[Tensor, "h w 1"]
    """Accumulated opacity, 0…1."""
    depth: Float[Tensor, "h w 1"] | None
    """Expected distance along the camera's z axis, world units; 0 where alpha is 0."""
    info: dict[str, Any] = field(default_factory=dict)
    """Inputs of gsplat's densification strategies: image size, screen positions and radii."""
