"""Projection of Gaussians to screen ellipses: the local affine (EWA) approximation with gradients."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.rendering.gaussians import FRUSTUM_MARGIN, MAX_SIGMA_PIXELS, Ellipses, Gaussians
from lang3dxl_ns.scene.camera import Camera


def project(
    gaussians: Gaussians, camera: Camera, *, near: float, eps2d: float, antialiased: bool
) -> Ellipses:
    """Project Gaussians to the screen (EWA splatting, Zwicker et al. 2001, with gsplat's conventions). `near`
    is in world units. `eps2d` is the variance added to both screen axes, in pixels². `antialiased` scales the
    opacity by the square root of the ratio of the determinants without and with `eps2d` (Mip-Splatting, Yu et
    al. 2024)."""
    view = camera.view_matrix.to(gaussians.means)
    intrinsics = camera.intrinsics.to(gaussians.means)
    points = gaussians.means @ view[:3, :3].T + view[:3, 3]
    with torch.no_grad():  # beyond the near plane, and not so large on screen that numbers overflow
        sigma = gaussians.scales.amax(1) * torch.maximum(intrinsics[0, 0], intrinsics[1, 1])
        drawable = (points[:, 2] > near) & (sigma < MAX_SIGMA_PIXELS * points[:, 2])
    points = torch.where(drawable[:, None], points, points.new_tensor([0.0, 0.0, 1.0]))
    scales = torch.where(drawable[:, None], gaussians.scales, 0.0)
    x, y, z = points.unbind(1)
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    slope_x, slope_y = x / z, y / z
    means2d = torch.stack([fx * slope_x + cx, fy * slope_y + cy], dim=1)[None]

    jacobian = torch.stack(
        [
            _jacobian_row(view[0, :3], view[2, :3], slope_x, z, fx, cx, camera.width),
            _jacobian_row(view[1, :3], view[2, :3], slope_y, z, fy, cy, camera.height),
        ],
        dim=1,
    )
    axes_x, axes_y = torch.bmm(jacobian, rotations(gaussians.quats) * scales[:, None]).unbind(1)
    # The determinant is the squared area of the parallelogram of the two rows (Cauchy-Binet), and the
    # determinant of the blurred covariance a sum of positive terms. Nothing cancels, so float32 is enough for
    # needles, where xx·yy − xy² would lose all digits.
    area = torch.linalg.vector_norm(torch.linalg.cross(axes_x, axes_y), dim=1)
    xx, yy, xy = axes_x.square().sum(1), axes_y.square().sum(1), (axes_x * axes_y).sum(1)
    determinant = (area.square() + eps2d * (xx + yy) + eps2d**2).clamp_min(1e-10)
    xx, yy = xx + eps2d, yy + eps2d
    conics = torch.stack([yy, -xy, xx], dim=1) / determinant[:, None]

    opacities = torch.where(drawable, gaussians.opacities, 0.0)
    if antialiased:
        opacities = opacities * area / determinant.sqrt()
    with torch.no_grad():  # gsplat's radius, 0 where it misses the image
        spread = (0.25 * (xx - yy).square() + xy.square()).clamp_min(0.01).sqrt()
        radii = (3 * (0.5 * (xx + yy) + spread).sqrt()).ceil()
        last, first = means2d[0].T + radii, means2d[0].T - radii
        inside = (last > 0).all(0) & (first[0] < camera.width) & (first[1] < camera.height) & drawable
    return Ellipses(means2d, conics, torch.stack([xx, yy], dim=1), z, opacities, (radii * inside).int()[None])


def _jacobian_row(
    axis: Float[Tensor, " 3"],
    forward: Float[Tensor, " 3"],
    slope: Float[Tensor, " n"],
    z: Float[Tensor, " n"],
    focal: Tensor,
    center: Tensor,
    size: int,
) -> Float[Tensor, "n 3"]:
    """Compute a pixel coordinate's derivative by the world position, from camera axes in the world frame."""
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    slope = slope.clamp(-center / focal - margin, (size - center) / focal + margin)
    return (focal / z)[:, None] * (axis - slope[:, None] * forward)


def rotations(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Compute rotation matrices of quaternions (w, x, y, z) of any length; length zero gives the identity."""
    w, x, y, z = F.normalize(quats, dim=1).unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    entries = [
        1 - 2 * (yy + zz), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (xx + zz), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (xx + yy),
    ]  # fmt: skip
    return torch.stack(entries, dim=1).view(-1, 3, 3)
