"""Bounds of Gaussians in training: lengths, colors, and the space at the cameras.

What few photos see may grow into a sheet across the scene, or hang where only a new view looks through it.
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
"""The same for Gaussians more than twice as long as wide; ground and distant hills are wide."""
EVERY = 10
"""Training steps from one correction to the next: with harmonics it takes a fifth of a short step."""
FREE = 0.02
"""Radius of the space around every training camera that stays empty, relative to the scene's radius."""
_STEEPEST = 0.5
"""Norm of a color's harmonics above degree 0, per channel."""
_ROWS = 16_384
"""Gaussians at a time, to bound memory."""


@torch.no_grad()
def keep_in_bounds(
    gaussians: torch.nn.ParameterDict, center: Float[Tensor, "3"], radius: float, first: int, degree: int
) -> None:
    """Shorten Gaussians that are too long and bring their colors to 0…1, in place.

    Args:
        gaussians: parameters, as of `initial_gaussians`, with colors of harmonics up to `degree`.
        center, radius: of the scene, world units.
        first: Gaussians before this one, the sky's, stay as they are.
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
    """Which positions lie within a distance of one of the cameras, all in world units."""
    cameras = cameras.to(means)
    return torch.cat([torch.cdist(some, cameras).amin(1) < distance for some in means.split(_ROWS)])
