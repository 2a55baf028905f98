"""Screen ellipses, to which Gaussians are projected, and the rendering rules that all backends share."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

ALPHA_MIN = 1 / 255
"""Alpha below which a Gaussian is skipped in a pixel."""
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
"""Transmittance at which a pixel stops: before the Gaussian that would bring it to this value or below."""
FRUSTUM_MARGIN = 0.3
"""Share of the image's half size by which positions may lie outside it in the Jacobian. Farther ones are
clamped, because the affine approximation is poor there (gsplat 1.4's rule)."""
MAX_SIGMA_PIXELS = 1e8
"""Largest standard deviation of an ellipse, pixels. Larger ones overflow float32 in the determinant; only
Gaussians around the camera reach it."""
REACH_SLACK = 1e-3
"""Margin added to pixel ranges, pixels, so that rounding never drops a visible pair."""


@dataclass
class Ellipses:
    """Screen ellipses, one for every Gaussian. Radius and opacity are 0 for those not visible."""

    means2d: Float[Tensor, "1 n 2"]
    """Centers, pixels from the top-left corner. They are one tensor with gsplat's leading camera axis,
    because densification reads the gradient from it."""
    conics: Float[Tensor, "n 3"]
    """Inverse covariances (xx, xy, yy), pixels⁻²."""
    variances: Float[Tensor, "n 2"]
    """Diagonal of the covariances (xx, yy), pixels². The compiled kernels give it no gradient."""
    depths: Float[Tensor, " n"]
    """Distance along the camera's z axis, world units."""
    opacities: Float[Tensor, " n"]
    radii: Int[Tensor, "1 n"]
    """Three standard deviations along the long axis, whole pixels; 0 if not visible."""
