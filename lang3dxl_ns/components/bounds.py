"""Bounds of Gaussians in training: lengths, colors, and the space around the cameras.

Few photos leave much unseen. There a Gaussian may grow into a sheet across the scene, or hang before a lens
that takes no photo of training; views from between the photos show it.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.components.initialization import color_parameters

LONGEST = 0.25
"""Longest standard deviation, relative to the scene's radius or, outside, to the distance from its center."""
FREE = 0.02
"""Radius of the space around every camera of training that stays empty, relative to the scene's radius."""
_STEEPEST = 0.5
"""Norm of a color's harmonics above degree 0, per channel."""
_ROWS = 16_384
"""Gaussians at a time, to bound memory."""


@torch.no_grad()
def keep_in_bounds(
    gaussians: torch.nn.ParameterDict, center: Float[Tensor, "3"], radius: float, first: int, degree: int
) -> None:
    """Shorten Gaussians that are too long, and bring their colors into 0…1, in place.

    Args:
        gaussians: parameters, as `initial_gaussians` makes them.
        center, radius: of the scene, world units.
        first: Gaussians before this one, the sky's, stay as they are.
        degree: of the colors' spherical harmonics. At degree 0 colors are logits, always in bounds.
    """
    means, scales = gaussians["means"][first:], gaussians["scales"][first:]
    away = (means - center.to(means)).norm(dim=1, keepdim=True).clamp_min(radius)
    scales.copy_(scales.minimum((LONGEST * away).log()))
    if degree > 0:
        black, white = color_parameters(means.new_tensor([[0.0], [1.0]]), degree).flatten().tolist()
        gaussians["features_dc"][first:].clamp_(black, white)
        rest = gaussians["features_rest"][first:]
        rest.mul_(_STEEPEST / rest.norm(dim=1, keepdim=True).clamp_min(_STEEPEST))


@torch.no_grad()
def near_cameras(
    means: Float[Tensor, "n 3"], cameras: Float[Tensor, "p 3"], distance: float
) -> Bool[Tensor, " n"]:
    """Which positions lie within a distance of any of the cameras' (world units)."""
    if not len(cameras):
        return means.new_zeros(len(means), dtype=torch.bool)
    cameras = cameras.to(means)
    return torch.cat([torch.cdist(some, cameras).amin(1) < distance for some in means.split(_ROWS)])
