"""`Splats`: the Gaussians of a finished scene, as an immutable value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from math import isqrt
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.rendering.gaussians import Gaussians
from lang3dxl_ns.rendering.spherical_harmonics import BAND_0, rotated_harmonics, spherical_harmonics

_TO_SCIPY, _FROM_SCIPY = [1, 2, 3, 0], [3, 0, 1, 2]
"""Columns of quaternions w, x, y, z in scipy's order, and of scipy's in ours."""


@dataclass(frozen=True, eq=False, repr=False)
class Splats:
    """Gaussians with activated values (no logarithms, no logits) and colors, without gradients. All tensors
    are on one device. They must not be written to: renderings in other threads may be reading them."""

    means: Float[Tensor, "n 3"]
    """Centers, world units."""
    quats: Float[Tensor, "n 4"]
    """Rotations as quaternions (w, x, y, z) of any length; zero length means no rotation."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the rotated axes, world units, positive."""
    opacities: Float[Tensor, " n"]
    """Peak opacity, 0…1."""
    harmonics: Float[Tensor, "n k 3"]
    """Spherical harmonics of the colors, degrees 0 to 3, the constant ones first (k = 1, 4, 9 or 16)."""
    antialiased: bool = False
    """Whether small Gaussians are dimmed by what the screen-space blur adds to their area, as in training."""

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"Splats({len(self):,} Gaussians, harmonics of degree {self.degree}, on {self.means.device})"

    @property
    def degree(self) -> int:
        """Degree of the harmonics; 0 for colors that do not depend on the viewing direction."""
        return isqrt(self.harmonics.shape[1]) - 1

    @property
    def gaussians(self) -> Gaussians:
        """Shapes of the Gaussians, as `rasterize` takes them."""
        return Gaussians(self.means, self.quats, self.scales, self.opacities)

    def colors(self, center: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        """Compute red, green and blue, 0 and above, as seen from a point in the world frame."""
        directions = self.means - to_device(center.to(self.means.dtype), self.means.device)
        return (spherical_harmonics(self.degree, directions, self.harmonics) + 0.5).clamp_min(0.0)

    def with_colors(self, colors: Float[Tensor, "n 3"]) -> Splats:
        """Return the same Gaussians in colors (0 and above) that do not depend on the viewing direction."""
        return replace(self, harmonics=harmonics_of(colors))

    def to(self, device: torch.device | str) -> Splats:
        """Return the same Gaussians on a device."""
        return self._mapped(lambda tensor: tensor.to(device))

    def copied(self) -> Splats:
        """Copy the Gaussians to new memory."""
        return self._mapped(torch.clone)

    def select(self, which: Bool[Tensor, " n"] | Int[Tensor, " m"]) -> Splats:
        """Return some of the Gaussians, chosen by a mask or by their indices (tensors or NumPy arrays)."""
        rows = torch.as_tensor(which, device=self.means.device)
        return self._mapped(lambda tensor: tensor[rows])

    def transformed(self, similarity: Float[Tensor, "4 4"]) -> Splats:
        """Transform the Gaussians to another frame by [[s·R, t], [0, 1]], with a rotation R, a scale s > 0
        and a translation t. Raises ValueError for another matrix."""
        from scipy.spatial.transform import Rotation

        turned = similarity[:3, :3].double().cpu()
        scale = float(turned.det().clamp_min(0) ** (1 / 3))
        rotation = turned / max(scale, 1e-30)
        if not torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=rotation.dtype), atol=1e-3):
            raise ValueError("the matrix is not a rotation, a uniform scale and a translation")
        like = self.means
        means = scale * (like @ rotation.T.to(like)) + similarity[:3, 3].to(like)
        identity = self.quats.new_tensor([1.0, 0, 0, 0])
        quats = torch.where(self.quats.norm(dim=1, keepdim=True) > 0, self.quats, identity).double().cpu()
        turns = Rotation.from_matrix(rotation.numpy()) * Rotation.from_quat(quats[:, _TO_SCIPY].numpy())
        return replace(
            self,
            means=means,
            quats=torch.from_numpy(turns.as_quat()[:, _FROM_SCIPY]).to(self.quats),
            scales=scale * self.scales,
            harmonics=rotated_harmonics(self.harmonics, rotation),
        )

    def sound(self) -> Bool[Tensor, " n"]:
        """Return which Gaussians have no NaN or infinite value."""
        parts = (self.means, self.quats, self.scales, self.opacities, self.harmonics)
        return torch.stack([part.reshape(len(self), -1).isfinite().all(1) for part in parts]).all(0)

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> Splats:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        changed: dict[str, Any] = {n: change(v) for n, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **changed)


def harmonics_of(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Compute harmonics of degree 0 for colors that do not depend on the viewing direction."""
    return (colors[:, None] - 0.5) / BAND_0
