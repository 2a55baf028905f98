"""Sky: opaque Gaussians on a sphere around the scene, with colors that are one smooth function.

Colors learned one by one are blotchy after short runs, since each photo shows only a few of them. Where
no photo looked, they stay gray.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.rendering import Gaussians, spherical_harmonics

DEGREE = 2
"""Degree of the spherical harmonics."""
OPACITY = 0.98
"""Opacity of the sky's Gaussians. It is high, since nothing lies behind them."""


class Sky(nn.Module):
    """Sky of a scene, which is its first Gaussians, in given directions (of any length) from its center. In
    training they don't move, and share nine colors. Outside training they are Gaussians like any others, with
    the colors that they had last."""

    directions: Float[Tensor, "k 3"]

    def __init__(self, directions: Float[Tensor, "k 3"]) -> None:
        super().__init__()
        self.register_buffer("directions", directions)
        self.harmonics = nn.Parameter(directions.new_zeros((DEGREE + 1) ** 2, 3))

    def __len__(self) -> int:
        return len(self.directions)

    @property
    def colors(self) -> Float[Tensor, "k 3"]:
        """Colors of the sky's Gaussians, at least 0; gray before training."""
        shared = self.harmonics.expand(len(self), -1, -1)
        return (spherical_harmonics(DEGREE, self.directions, shared) + 0.5).clamp_min(0.0)

    def forward(
        self, gaussians: Gaussians, colors: Float[Tensor, "n 3"]
    ) -> tuple[Gaussians, Float[Tensor, "n 3"]]:
        """Replace the colors of the first Gaussians by the sky's, and return all Gaussians and their colors.
        No gradient moves the sky's Gaussians; the gradient of their colors reaches the harmonics."""

        def still(values: Tensor) -> Tensor:
            return torch.cat((values[: len(self)].detach(), values[len(self) :]))

        return gaussians.mapped(still), torch.cat((self.colors, colors[len(self) :]))
