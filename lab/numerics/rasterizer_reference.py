"""Reference rasterizer, written for clarity: every Gaussian at every pixel, with gradients by autograd.

It shares no arithmetic with the tiled rasterizer, which is tested and measured against it. Use float64.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from lang3dxl_ns.rendering import Gaussians, Raster
from lang3dxl_ns.scene.camera import Camera

PIXELS_AT_A_TIME = 64


def rasterize_reference(
    gaussians: Gaussians,
    camera: Camera,
    channels: Float[Tensor, "n c"],
    background: Float[Tensor, " c"] | None = None,
    *,
    render_depth: bool = False,
    antialiased: bool = False,
    near: float = 0.01,
    eps2d: float = 0.3,
) -> Raster:
    """Rasterize finite values like `rasterize`, in time ∝ Gaussians × pixels. `info` stays empty."""
    means2d, axes, depths = project_reference(gaussians, camera)
    whitening = whitening_reference(axes, eps2d)
    opacities = gaussians.opacities
    if antialiased:
        sharp = torch.sqrt(torch.linalg.det(axes @ axes.mT))
        opacities = opacities * sharp * torch.linalg.det(whitening).abs()
    order = torch.argsort(depths, stable=True)
    order = order[depths[order] > near]
    values = torch.cat([channels, torch.ones_like(depths)[:, None], depths[:, None]], dim=1)
    maps = composite_reference(
        means2d[order], whitening[order], opacities[order], values[order], camera.width, camera.height
    )

    image, alpha, depth = maps.split([channels.shape[1], 1, 1], dim=2)
    if background is not None:
        image = image + (1 - alpha) * background
    expected_depth = torch.where(alpha > 0, depth / alpha.clamp_min(1e-12), 0.0) if render_depth else None
    return Raster(image, alpha, expected_depth)


def project_reference(
    gaussians: Gaussians, camera: Camera
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 3"], Float[Tensor, " n"]]:
    """Compute pixel centers, axes A with screen covariance A Aᵀ (pixels), and depths by textbook formulas."""
    q = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True)
    identity = torch.eye(3).to(q).expand(len(q), 3, 3)
    cross = torch.linalg.cross(q[:, None, 1:].expand(-1, 3, 3), identity).mT
    rotations = identity + 2 * q[:, :1, None] * cross + 2 * cross @ cross  # Rodrigues
    axes = rotations @ torch.diag_embed(gaussians.scales)

    view_rotation, translation = camera.view_matrix[:3, :3], camera.view_matrix[:3, 3]
    points = gaussians.means @ view_rotation.T + translation
    homogeneous = points @ camera.intrinsics.T
    means2d = homogeneous[:, :2] / homogeneous[:, 2:]

    focal, center = camera.intrinsics.diagonal()[:2], camera.intrinsics[:2, 2]
    size = torch.tensor([camera.width, camera.height]).to(points)
    margin = 0.3 * size / (2 * focal)
    depths = points[:, 2]
    slopes = points[:, :2] / depths[:, None]
    slopes = slopes.clamp(-center / focal - margin, (size - center) / focal + margin)
    jacobian = torch.cat([torch.diag(focal).expand(len(q), 2, 2), -(focal * slopes)[:, :, None]], dim=2)
    to_screen = jacobian / depths[:, None, None] @ view_rotation
    return means2d, to_screen @ axes, depths


def whitening_reference(axes: Float[Tensor, "n 2 3"], eps2d: float) -> Float[Tensor, "n 2 2"]:
    """Compute W, for which W Wᵀ is the inverse of the blurred covariance A Aᵀ + ε.

    QR is used because it never squares the axes: the covariance of a needle that is a million pixels long has
    too many digits for float64.
    """
    blur = eps2d**0.5 * torch.eye(2).to(axes).expand(len(axes), 2, 2)
    _, triangle = torch.linalg.qr(torch.cat([axes.mT, blur], dim=1))
    return torch.linalg.inv(triangle)


def composite_reference(
    means2d: Float[Tensor, "n 2"],
    whitening: Float[Tensor, "n 2 2"],
    opacities: Float[Tensor, " n"],
    values: Float[Tensor, "n c"],
    width: int,
    height: int,
) -> Float[Tensor, "h w c"]:
    """Composite Gaussians that are sorted front to back over black."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], dim=-1).view(-1, 2).to(means2d)

    def block_maps(block: Tensor, *splats: Tensor) -> Tensor:
        return pixel_weights(block, *splats[:3]) @ splats[3]

    maps = []
    for block in pixels.split(PIXELS_AT_A_TIME):
        # Dropping Gaussians skipped in every pixel of the block changes nothing and saves memory.
        with torch.no_grad():
            used = (pixel_alphas(block, means2d, whitening, opacities) > 0).any(0)
        splats = [value[used] for value in (means2d, whitening, opacities, values)]
        maps.append(checkpoint(block_maps, block, *splats, use_reentrant=False))
    return torch.cat(maps).view(height, width, -1)


def pixel_weights(
    pixels: Float[Tensor, "p 2"],
    means2d: Float[Tensor, "n 2"],
    whitening: Float[Tensor, "n 2 2"],
    opacities: Float[Tensor, " n"],
) -> Float[Tensor, "p n"]:
    """Compute alpha × transmittance; 0 from the first Gaussian that would lower transmittance to ≤ 1e-4."""
    alphas = pixel_alphas(pixels, means2d, whitening, opacities)
    after = torch.cumprod(1 - alphas, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    return torch.where(after > 1e-4, alphas * before, 0.0)


def pixel_alphas(
    pixels: Float[Tensor, "p 2"],
    means2d: Float[Tensor, "n 2"],
    whitening: Float[Tensor, "n 2 2"],
    opacities: Float[Tensor, " n"],
) -> Float[Tensor, "p n"]:
    """Compute opacity × Gaussian, at most 0.999, and 0 below 1/255."""
    x, y = pixels[:, :1] - means2d[:, 0], pixels[:, 1:] - means2d[:, 1]
    first, second = (x * column[:, 0] + y * column[:, 1] for column in whitening.unbind(2))
    alphas = opacities * torch.exp(-0.5 * (first.square() + second.square()))
    return torch.where(alphas >= 1 / 255, alphas.clamp_max(0.999), 0.0)
