"""Bounds of Gaussians in training: lengths, colors, and empty space around the cameras.

Gaussians that few photos see may grow into sheets across the scene, or float where only new views see them.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.components.initialization import color_parameters

LONGEST = 1.0
"""Longest standard deviation, relative to the scene's radius or, outside, to the distance from its center."""
NEEDLE = 0.25
"""Like `LONGEST`, for Gaussians more than twice as long as wide; ground and distant hills are wide."""
EVERY = 10
"""Training steps between two corrections; with harmonics, one takes a fifth of the time of a short step."""
FREE = 0.02
"""Radius of the space around every training camera that stays empty, relative to the scene's radius."""
_STEEPEST = 0.5
"""Largest norm of a color's harmonics above degree 0, per channel."""
_ROWS = 16_384
"""Number of Gaussians processed at a time, to bound memory."""


@torch.no_grad()
def keep_in_bounds(
    gaussians: torch.nn.ParameterDict, center: Float[Tensor, "3"], radius: float, first: int, degree: int
) -> None:
    """Shorten Gaussians that are too long and bring their colors to 0…1, in place.

    Args:
        gaussians: parameters like those of `initial_gaussians`.
        center, radius: center and radius of the scene, world units.
        first: row of the first Gaussian to change; those before it are the sky's.
        degree: degree of the colors' spherical harmonics.
    """
    g = {name: parameter[first:] for name, parameter in gaussians.items()}
    away = (g["means"] - to_device(center, g["means"].device)).norm(dim=1, keepdim=True).clamp_min(radius)
    wide = 2 * g["scales"].median(dim=1, keepdim=True).values.exp()
    longest = wide.maximum(NEEDLE * away).minimum(LONGEST * away)
    g["scales"].copy_(g["scales"].minimum(longest.log()))
    if degree > 0:  # otherwise colors are logits
        g["features_dc"].clamp_(*color_parameters(torch.tensor([[0.0], [1.0]]), degree).flatten().tolist())
        norms = g["features_rest"].norm(dim=1, keepdim=True)
        g["features_rest"].mul_(_STEEPEST / norms.clamp_min(_STEEPEST))


@torch.no_grad()
def near_cameras(
    means: Float[Tensor, "n 3"], cameras: Float[Tensor, "p 3"], distance: float
) -> Bool[Tensor, " n"]:
    """Return which positions lie within a distance of any of the cameras, all in world units."""
    cameras = cameras.to(means)
    return torch.cat([torch.cdist(some, cameras).amin(1) < distance for some in means.split(_ROWS)])
