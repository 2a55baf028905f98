"""The Gaussians that training starts from: the COLMAP points, and a sky."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.models.splatfacto import RGB2SH, num_sh_bases
from sklearn.neighbors import NearestNeighbors
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.geometry import sphere_around
from lang3dxl_ns.model_config import Lang3DXLModelConfig


def seed_positions(
    config: Lang3DXLModelConfig, seed_points: tuple[Tensor, Tensor] | None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Where Gaussians start, and their colours (0…1): the scene's points, or random ones in a box."""
    if seed_points is not None and not config.random_init:
        return seed_points[0].float(), seed_points[1].float() / 255
    means = (torch.rand(config.num_random, 3) - 0.5) * config.random_scale
    return means, torch.rand(config.num_random, 3)


def initial_gaussians(
    config: Lang3DXLModelConfig, means: Float[Tensor, "n 3"], colours: Float[Tensor, "n 3"]
) -> dict[str, Parameter]:
    """A Gaussian per position, as wide as the mean distance to its three nearest neighbours, and the sky.

    Raises UserError when there are fewer than four.
    """
    if config.sky_gaussians:
        sky = sphere_around(means, config.sky_gaussians)
        means = torch.cat([means, sky])
        colours = torch.cat([colours, torch.full_like(sky, 0.5)])
    n = len(means)
    if n < 4:
        raise UserError(
            f"the scene has {n} seed points, too few to start from: reconstruct it again, or pass "
            f"--pipeline.model.random-init True"
        )
    return {
        "means": Parameter(means),
        "scales": Parameter(_spacing(means).log().repeat(1, 3)),
        # Uniform over rotations; from a generator of its own, so that preparation has no say in it.
        "quats": Parameter(F.normalize(torch.randn(n, 4, generator=torch.Generator().manual_seed(0)), dim=1)),
        "features_dc": Parameter(RGB2SH(colours) if config.sh_degree > 0 else torch.logit(colours, eps=1e-4)),
        "features_rest": Parameter(torch.zeros(n, num_sh_bases(config.sh_degree) - 1, 3)),
        "opacities": Parameter(torch.logit(0.1 * torch.ones(n, 1))),
    }


def _spacing(means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
    points = means.numpy()
    distances = NearestNeighbors(n_neighbors=4).fit(points).kneighbors(points)[0][:, 1:]
    spacing = torch.from_numpy(distances).float().mean(dim=-1, keepdim=True)
    # Points that coincide would make Gaussians of no size.
    return spacing.clamp_min(1e-3 * float(spacing.median().clamp_min(1e-6)))
