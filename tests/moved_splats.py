"""Splats in another frame, or of other colors."""

from dataclasses import replace
from math import isqrt

import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.rendering.spherical_harmonics import BAND_0, _basis


def transformed(splats: Splats, similarity: Float[Tensor, "4 4"]) -> Splats:
    """The splats in the frame that [[s·R, t], [0, 1]] leads to."""
    turned = similarity[:3, :3].double()
    scale = float(turned.det() ** (1 / 3))
    rotation = turned / scale
    turns = Rotation.from_matrix(rotation.numpy()) * Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]].numpy())
    return replace(
        splats,
        means=scale * (splats.means @ rotation.T.to(splats.means)) + similarity[:3, 3].to(splats.means),
        quats=torch.from_numpy(turns.as_quat()[:, [3, 0, 1, 2]]).to(splats.quats),
        scales=scale * splats.scales,
        harmonics=rotated_harmonics(splats.harmonics, rotation),
    )


def rotated_harmonics(
    coefficients: Float[Tensor, "n k 3"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "n k 3"]:
    """The same colors after the world has been turned, solved for at a few directions, degree by degree."""
    generator = torch.Generator().manual_seed(0)
    directions = F.normalize(torch.randn(32, 3, generator=generator, dtype=torch.float64), dim=1)
    degree, parts = isqrt(coefficients.shape[1]) - 1, []
    before, after = _basis(degree, directions @ rotation.double()), _basis(degree, directions)
    for band in range(degree + 1):
        rows = slice(band**2, (band + 1) ** 2)
        mixing = torch.linalg.lstsq(after[:, rows], before[:, rows]).solution.to(coefficients)
        parts.append(torch.einsum("jk,nkc->njc", mixing, coefficients[:, rows]))
    return torch.cat(parts, dim=1)


def with_colors(splats: Splats, colors: Float[Tensor, "n 3"]) -> Splats:
    """The same Gaussians in colors that do not depend on the viewing direction."""
    return replace(splats, harmonics=(colors[:, None] - 0.5) / BAND_0)
