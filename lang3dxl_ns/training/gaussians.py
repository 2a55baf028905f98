"""Gaussians of training: their parameters, the initial ones (one per COLMAP point, and a sky), and bounds.

Gaussians that few photos see may grow into sheets across the scene, or float where only new views see them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import Parameter

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import model_option, switched_on
from lang3dxl_ns.rendering import Gaussians, harmonics_of
from lang3dxl_ns.rendering.gaussians import MAX_LOG_SCALE
from lang3dxl_ns.rendering.spherical_harmonics import spherical_harmonics

Parameters = MutableMapping[str, Parameter] | nn.ParameterDict
"""Parameters of Gaussians by name."""
FIRST_OPACITY = 0.1
FEWEST = 4
"""Smallest number of positions, so that each has three neighbors."""
MOST = 1_000_000
"""Largest number of points that Gaussians start from: a scanner's cloud has tens of millions."""

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


def seed_positions(
    points: tuple[Tensor, Tensor] | None, count: int, side: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Choose the initial positions of Gaussians and their colors (0…1): those of the points (whose colors are
    bytes), of some if there are over `MOST`, or, without points, `count` random ones in a box with this side
    in world units. Raises UserError if there are too few points."""
    if points is None:
        return (torch.rand(count, 3) - 0.5) * side, torch.rand(count, 3)
    if len(points[0]) < FEWEST:
        raise UserError(
            f"the scene has {len(points[0])} 3D points, too few to start from: reconstruct it again (colmap "
            f"point_triangulator), or start from random Gaussians: {switched_on(model_option('random-init'))}"
        )
    positions, colors = points
    if len(positions) > MOST:
        say(f"Gaussians start from {MOST:,} of the {len(positions):,} points; training adds what is missing")
        kept = torch.randperm(len(positions), generator=torch.Generator().manual_seed(0))[:MOST]
        positions, colors = positions[kept], colors[kept]
    return positions.float(), colors.float() / 255


def initial_gaussians(
    means: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"], sky: int, degree: int
) -> dict[str, Parameter]:
    """Create the parameters of the sky's Gaussians (`sky` of them, on a sphere around the positions), then of
    one Gaussian per position, as wide as the mean distance to its three nearest neighbors. There are at least
    `FEWEST` positions (world units), with colors in 0…1, stored as spherical harmonics of a degree."""
    sphere = sphere_around(means, sky)
    means = torch.cat([sphere, means])
    colors = torch.cat([torch.full_like(sphere, 0.5), colors])
    n = len(means)
    return {
        "means": Parameter(means),
        "scales": Parameter(_spacing(means).log().repeat(1, 3)),
        # Rotations are uniform, and drawn by their own generator, so that preparation does not affect them.
        "quats": Parameter(F.normalize(torch.randn(n, 4, generator=torch.Generator().manual_seed(0)), dim=1)),
        "features_dc": Parameter(color_parameters(colors, degree)),
        "features_rest": Parameter(torch.zeros(n, (degree + 1) ** 2 - 1, 3)),
        "opacities": Parameter(torch.logit(torch.full((n, 1), FIRST_OPACITY))),
    }


def activated(g: Mapping[str, Tensor] | nn.ParameterDict) -> Gaussians:
    """Activate the parameters `g`, which store log scales and logits of opacity, to Gaussians."""
    scales = g["scales"].clamp_max(MAX_LOG_SCALE).exp()
    return Gaussians(g["means"], g["quats"], scales, g["opacities"].sigmoid().squeeze(-1))


def colors_seen(
    g: Mapping[str, Tensor] | nn.ParameterDict, degree: int | None, center: Float[Tensor, "3"]
) -> Float[Tensor, "n 3"]:
    """Compute the colors of the parameters `g`, seen from a point (world units), by harmonics up to a degree.
    Without harmonics (None), colors are stored as logits."""
    if degree is None:
        return torch.sigmoid(g["features_dc"])
    directions = g["means"].detach() - center
    return (spherical_harmonics(degree, directions, harmonics(g)) + 0.5).clamp_min(0.0)


def harmonics(g: Mapping[str, Tensor] | nn.ParameterDict) -> Float[Tensor, "n k 3"]:
    """Return the stored harmonics of the parameters `g`, of all degrees."""
    return torch.cat((g["features_dc"][:, None], g["features_rest"]), dim=1)


def color_parameters(colors: Float[Tensor, "n 3"], degree: int) -> Float[Tensor, "n 3"]:
    """Convert colors (0…1) to stored parameters: harmonics of degree 0, or logits if `degree` is 0."""
    return harmonics_of(colors)[:, 0] if degree > 0 else torch.logit(colors, eps=1e-4)


def _spacing(means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
    points = means.numpy()
    distances = cKDTree(points).query(points, k=4)[0][:, 1:]
    spacing = torch.from_numpy(distances).float().mean(dim=-1, keepdim=True)
    # Coincident points would make Gaussians of zero size.
    return spacing.clamp_min(1e-3 * float(spacing.median().clamp_min(1e-6)))


def center_and_radius(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3"], float]:
    """Compute the median point of a scene, and the radius around it that contains 90 % of the points."""
    center = points.median(dim=0).values
    return center, float((points - center).norm(dim=1).quantile(0.9))


def sphere_around(points: Float[Tensor, "n 3"], count: int) -> Float[Tensor, "count 3"]:
    """Spread points evenly (as a Fibonacci lattice) on a sphere of ten times the scene's radius."""
    center, radius = center_and_radius(points)
    i = torch.arange(count) + 0.5
    z, longitude = 1 - 2 * i / count, i * math.pi * (3 - math.sqrt(5))
    around = (1 - z * z).sqrt()
    return center + 10 * radius * torch.stack([around * longitude.cos(), around * longitude.sin(), z], dim=1)


@torch.no_grad()
def keep_in_bounds(
    gaussians: nn.ParameterDict, center: Float[Tensor, "3"], radius: float, first: int, degree: int
) -> None:
    """Shorten Gaussians that are too long and bring their colors to 0…1, in place. Those before row `first`
    are the sky's, and stay. `center` and `radius` are the scene's, in world units; `degree` is that of the
    colors' spherical harmonics."""
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
    middle = cameras.to(means).mean(0)  # far from the origin, distances by matrix products are inexact
    cameras = cameras.to(means) - middle
    return torch.cat([torch.cdist(some - middle, cameras).amin(1) < distance for some in means.split(_ROWS)])
