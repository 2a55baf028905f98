"""Gaussians, their screen ellipses and rendered maps; the rendering rules that all backends share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.scene.camera import Camera

ALPHA_MIN = 1 / 255
"""Alpha below which a Gaussian is skipped in a pixel."""
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
"""Transmittance at which a pixel stops: before the Gaussian that would bring it to this value or below."""
FRUSTUM_MARGIN = 0.3
"""Share of the image's half size by which positions may lie outside it in the Jacobian. Farther ones are
clamped, because the affine approximation is poor there (gsplat 1.4's rule)."""
MAX_SIGMA_PIXELS = 1e8
"""Largest standard deviation of an ellipse, pixels. Larger ones overflow float32 in the determinant; only
Gaussians around the camera reach it."""
REACH_SLACK = 1e-3
"""Margin added to pixel ranges, pixels, so that rounding never drops a visible pair."""
MAX_LOG_SCALE = 60.0
"""Upper limit of log scales before `exp`. An infinite scale has the gradient 0 · ∞ = NaN."""
CLOSEST = 1.5
"""Depth from which Gaussians are visible, in standard deviations of their longest axis. They are fully
visible from twice this depth."""
Kind = TypeVar("Kind", bound="Gaussians")


@dataclass(frozen=True, eq=False)
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

    def mapped(self: Kind, change: Callable[[Tensor], Tensor]) -> Kind:
        """Return the Gaussians with a change to each of their tensors."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        changed: dict[str, Any] = {n: change(v) for n, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **changed)

    def seen_from(self: Kind, camera: Camera) -> Kind:
        """Return the same Gaussians, but transparent where their depth is small relative to their length. A
        splat's affine approximation holds only where a Gaussian is small for its depth. Without this, a
        Gaussian as small as a finger beside the picture would cover it when the camera is close to a wall."""
        with torch.no_grad():
            moved, place = camera.at_origin(self.means)
            depth = (self.means - place) @ moved.view_matrix[2, :3] + moved.view_matrix[2, 3]
            shown = (depth / (CLOSEST * self.scales.amax(1)).clamp_min(1e-30) - 1).clamp(0.0, 1.0)
        return replace(self, opacities=self.opacities * shown)


@dataclass(frozen=True)
class Ellipses:
    """Gaussians projected to the screen. Radius and opacity are 0 for those not visible."""

    means2d: Float[Tensor, "1 n 2"]
    """Centers, pixels from the top-left corner. They are one tensor with gsplat's leading camera axis,
    because densification reads the gradient from it."""
    conics: Float[Tensor, "n 3"]
    """Inverse covariances (xx, xy, yy), pixels⁻²."""
    variances: Float[Tensor, "n 2"]
    """Diagonal of the covariances (xx, yy), pixels²."""
    depths: Float[Tensor, " n"]
    """Distance along the camera's z axis, world units."""
    opacities: Float[Tensor, " n"]
    radii: Int[Tensor, "1 n"]
    """Three standard deviations along the long axis, whole pixels; 0 if not visible."""


@dataclass(frozen=True)
class Raster:
    """Maps of one rasterization, as training needs them."""

    image: Float[Tensor, "h w c"]
    """Channels composited over the background."""
    alpha: Float[Tensor, "h w 1"]
    """Accumulated opacity, 0…1."""
    depth: Float[Tensor, "h w 1"] | None
    """Expected distance along the camera's z axis, world units; 0 where alpha is 0."""
    info: dict[str, Any] = field(default_factory=dict)
    """Inputs of gsplat's densification strategies: image size, screen positions and radii."""
