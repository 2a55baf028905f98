"""The sky: opaque Gaussians on a sphere around the scene, with colors that are one smooth function.

Colors learned one by one are mottled after a run of minutes, since a photo shows a few of them only, and
gray where no photo looked.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.rendering.gaussians import Gaussians
from lang3dxl_ns.rendering.spherical_harmonics import spherical_harmonics

DEGREE = 2
"""Degree of the spherical harmonics."""
OPACITY = 0.98
"""Opacity of the sky's Gaussians. It is high, since nothing lies behind them."""


class Sky(nn.Module):
    """The first Gaussians of a scene. In training they stay where they are, and share nine colors.

    Outside training they are Gaussians like any others, with the colors that they had last.

    Args:
        directions: of the Gaussians from the scene's center, of any length.
    """

    directions: Float[Tensor, "k 3"]

    def __init__(self, directions: Float[Tensor, "k 3"]) -> None:
        super().__init__()
        self.register_buffer("directions", directions)
        self.harmonics = nn.Parameter(directions.new_zeros((DEGREE + 1) ** 2, 3))

    def __len__(self) -> int:
        return len(self.directions)

    @property
    def colors(self) -> Float[Tensor, "k 3"]:
        """Colors of the Gaussians, at least 0; gray at first."""
        shared = self.harmonics.expand(len(self), -1, -1)
        return (spherical_harmonics(DEGREE, self.directions, shared) + 0.5).clamp_min(0.0)

    def forward(
        self, gaussians: Gaussians, colors: Float[Tensor, "n 3"]
    ) -> tuple[Gaussians, Float[Tensor, "n 3"]]:
        """All Gaussians and their colors, the first of which are the sky's: no gradient moves them, and that
        of their colors reaches the harmonics."""

        def still(values: Tensor) -> Tensor:
            return torch.cat((values[: len(self)].detach(), values[len(self) :]))

        kept = Gaussians(*map(still, vars(gaussians).values()))
        return kept, torch.cat((self.colors, colors[len(self) :]))
