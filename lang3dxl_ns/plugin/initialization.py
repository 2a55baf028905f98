"""Initial Gaussians of training: from the COLMAP points, and a sky."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.model_config import ModelSettings
from lang3dxl_ns.plugin.splatfacto import RGB2SH, num_sh_bases
from lang3dxl_ns.scene.geometry import sphere_around

FIRST_OPACITY = 0.1
FEWEST = 4
"""Fewest positions, so that each has three neighbors."""


def seed_positions(
    config: ModelSettings, seed_points: tuple[Tensor, Tensor] | None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Initial positions of Gaussians and their colors (0…1): the scene's points, or random ones in a box.

    Raises UserError if the scene has too few points.
    """
    if seed_points is not None and not config.random_init:
        if len(seed_points[0]) < FEWEST:
            raise UserError(
                f"the scene has {len(seed_points[0])} 3D points, too few to start from: reconstruct it "
                "again (colmap point_triangulator), or start from random Gaussians: "
                "--pipeline.model.random-init True"
            )
        return seed_points[0].float(), seed_points[1].float() / 255
    means = (torch.rand(config.num_random, 3) - 0.5) * config.random_scale
    return means, torch.rand(config.num_random, 3)


def initial_gaussians(
    config: ModelSettings, means: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"]
) -> dict[str, Parameter]:
    """The sky's Gaussians, and one per position (at least `FEWEST`), as wide as the mean distance to its
    three nearest neighbors."""
    sky = sphere_around(means, config.sky_gaussians)
    means = torch.cat([sky, means])
    colors = torch.cat([torch.full_like(sky, 0.5), colors])
    n = len(means)
    return {
        "means": Parameter(means),
        "scales": Parameter(_spacing(means).log().repeat(1, 3)),
        # Uniform over rotations; with its own generator, so that preparation does not affect it.
        "quats": Parameter(F.normalize(torch.randn(n, 4, generator=torch.Generator().manual_seed(0)), dim=1)),
        "features_dc": Parameter(color_parameters(config, colors)),
        "features_rest": Parameter(torch.zeros(n, num_sh_bases(config.sh_degree) - 1, 3)),
        "opacities": Parameter(torch.logit(torch.full((n, 1), FIRST_OPACITY))),
    }


def color_parameters(config: ModelSettings, colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Colors (0…1) as the model stores them: harmonics of degree 0, or logits where these are all."""
    return RGB2SH(colors) if config.sh_degree > 0 else torch.logit(colors, eps=1e-4)


def _spacing(means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
    points = means.numpy()
    distances = cKDTree(points).query(points, k=4)[0][:, 1:]
    spacing = torch.from_numpy(distances).float().mean(dim=-1, keepdim=True)
    # Coincident points would make Gaussians of zero size.
    return spacing.clamp_min(1e-3 * float(spacing.median().clamp_min(1e-6)))
