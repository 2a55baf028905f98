"""Screen ellipses, what Gaussians are projected to, and the rules of rendering that all backends share."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

ALPHA_MIN = 1 / 255
"""Alpha below which a Gaussian is skipped in a pixel."""
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
"""A pixel stops before the Gaussian that would bring its transmittance to this or below."""
FRUSTUM_MARGIN = 0.3
"""The affine approximation is poor far outside the image, so it is evaluated at a position clamped to the
image plus this share of its half size on every side (gsplat 1.4's rule)."""
MAX_SIGMA_PIXELS = 1e8
"""Larger ellipses overflow float32 in the determinant; only Gaussians around the camera are so large."""
REACH_SLACK = 1e-3
"""Pixel ranges are widened by this much, so that rounding never drops a visible pair."""


@dataclass
class Ellipses:
    """One ellipse for every Gaussian; radius and opacity are 0 for those not visible."""

    means2d: Float[Tensor, "1 n 2"]
    """Centers, pixels from the top-left corner. One tensor with gsplat's leading camera axis, because
    densification reads the gradient from it."""
    conics: Float[Tensor, "n 3"]
    """Inverse covariances (xx, xy, yy), pixels⁻²."""
    variances: Float[Tensor, "n 2"]
    """Diagonal of the covariances (xx, yy), pixels²; without gradient from the compiled kernels."""
    depths: Float[Tensor, " n"]
    """Distance along the camera's z axis, world units."""
    opacities: Float[Tensor, " n"]
    radii: Int[Tensor, "1 n"]
    """Three standard deviations along the long axis, whole pixels; 0 if not visible."""
