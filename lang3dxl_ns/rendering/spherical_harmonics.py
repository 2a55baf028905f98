"""View-dependent color: real spherical harmonics up to degree 3."""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from lang3dxl_ns.common.device import in_full_precision

BAND_0 = math.sqrt(1 / (4 * math.pi))
"""Value of the constant harmonic: color = 0.5 + this × coefficient."""
_BAND_1 = math.sqrt(3 / (4 * math.pi))
_BAND_2 = math.sqrt(15 / (4 * math.pi))
_BAND_2_ZONAL = math.sqrt(5 / (16 * math.pi))
_BAND_3_SECTORAL = math.sqrt(35 / (32 * math.pi))
_BAND_3_XYZ = math.sqrt(105 / (4 * math.pi))
_BAND_3_TESSERAL = math.sqrt(21 / (32 * math.pi))
_BAND_3_ZONAL = math.sqrt(7 / (16 * math.pi))


def _basis(degree: int, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n k"]:
    """Evaluate the basis functions at unit directions, with the signs used in Gaussian splatting files."""
    x, y, z = directions.unbind(1)
    columns = [torch.full_like(x, BAND_0)]
    if degree >= 1:
        columns += [-_BAND_1 * y, _BAND_1 * z, -_BAND_1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        columns += [
            _BAND_2 * x * y,
            -_BAND_2 * y * z,
            _BAND_2_ZONAL * (2 * zz - xx - yy),
            -_BAND_2 * x * z,
            0.5 * _BAND_2 * (xx - yy),
        ]
    if degree >= 3:
        columns += [
            -_BAND_3_SECTORAL * y * (3 * xx - yy),
            _BAND_3_XYZ * x * y * z,
            -_BAND_3_TESSERAL * y * (4 * zz - xx - yy),
            _BAND_3_ZONAL * z * (2 * zz - 3 * xx - 3 * yy),
            -_BAND_3_TESSERAL * x * (4 * zz - xx - yy),
            0.5 * _BAND_3_XYZ * z * (xx - yy),
            -_BAND_3_SECTORAL * x * (xx - 3 * yy),
        ]
    return torch.stack(columns, dim=1)


@in_full_precision
def spherical_harmonics(
    degree: int, directions: Float[Tensor, "n 3"], coefficients: Float[Tensor, "n k 3"]
) -> Float[Tensor, "n 3"]:
    """Evaluate one color per Gaussian from its coefficients; the caller adds 0.5 and clamps. Directions
    (camera center to Gaussian, world frame) may have any length. Bands above `degree` are ignored. Signs and
    order are those of Kerbl et al. 2023 (3D Gaussian Splatting). Raises ValueError for a degree that is not
    0…3, or needs more coefficients than there are."""
    count = (degree + 1) ** 2
    if not 0 <= degree <= 3 or count > coefficients.shape[1]:
        raise ValueError(
            f"spherical harmonics of degree {degree} need degree 0…3 and {count} coefficients per "
            f"Gaussian; there are {coefficients.shape[1]}"
        )
    basis = _basis(degree, F.normalize(directions, dim=1))
    return _Sum.apply(basis, coefficients[:, :count])


class _Sum(torch.autograd.Function):
    """Sum of coefficients by their basis. Autograd's own gradient, a matrix product per Gaussian, takes twice
    as long."""

    @staticmethod
    def forward(ctx: Any, basis: Tensor, coefficients: Tensor) -> Float[Tensor, "n 3"]:  # type: ignore[override]
        ctx.save_for_backward(basis, coefficients if ctx.needs_input_grad[0] else None)
        return torch.einsum("nk,nkc->nc", basis, coefficients)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, Tensor | None]:  # type: ignore[override]
        basis, coefficients = ctx.saved_tensors
        moves, learns = ctx.needs_input_grad
        of_basis = torch.einsum("nc,nkc->nk", slope, coefficients) if moves else None
        return of_basis, basis[:, :, None] * slope[:, None] if learns else None
