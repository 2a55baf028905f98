"""Baseline rasterizer in plain torch: dense, tile by tile, differentiated by autograd."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lab.benchmarks.rasterizer_scenes import CHANNELS, Problem
from lang3dxl_ns.rendering import Camera, Gaussians

DENSE_TILE = 16
"""Pixels per side. Of 16, 32 and 64 the fastest in all measured cases, hence the fairest comparison."""
DENSE_BYTES_PER_PAIR = 55
"""Bytes that autograd keeps per pixel and Gaussian of a tile, float32, measured."""


def render_dense(problem: Problem) -> tuple[Float[Tensor, "h w 6"], Float[Tensor, "h w 1"]]:
    """A short rasterizer in plain torch: every Gaussian of a tile at every pixel of it.

    Follows gsplat's rendering rules but shares no code with `rasterize`, so it is also the float64 reference.
    """
    columns = -(-problem.camera.width // DENSE_TILE)
    payload = torch.cat([problem.channels, torch.ones_like(problem.channels[:, :1])], dim=1)
    tiles = _dense_tiles(problem.gaussians, problem.camera)
    maps = [(weights @ payload.index_select(0, index)).unflatten(0, size) for index, weights, size in tiles]
    rows = [torch.cat(maps[first : first + columns], dim=1) for first in range(0, len(maps), columns)]
    image, alpha = torch.cat(rows).split([CHANNELS, 1], dim=2)
    return image + (1 - alpha) * problem.background, alpha


@torch.no_grad()
def count_pairs(gaussians: Gaussians, camera: Camera) -> tuple[int, int]:
    """Pairs of pixel and Gaussian: those that contribute, and those that `render_dense` evaluates."""
    tiles = _dense_tiles(gaussians, camera)
    counts = [(int((weights > 0).sum()), weights.numel()) for _, weights, _ in tiles]
    kept, evaluated = (sum(column) for column in zip(*counts, strict=True))
    return kept, evaluated


def _dense_tiles(
    gaussians: Gaussians, camera: Camera
) -> Iterator[tuple[Int[Tensor, " m"], Float[Tensor, "p m"], tuple[int, int]]]:
    """For every tile, row by row: its Gaussians front to back, their weights in each pixel, its size."""
    order, centers, conics, opacities, reach = _splats(gaussians, camera)
    with torch.no_grad():
        low, high = centers - reach, centers + reach
    for top in range(0, camera.height, DENSE_TILE):
        for left in range(0, camera.width, DENSE_TILE):
            right, bottom = min(left + DENSE_TILE, camera.width), min(top + DENSE_TILE, camera.height)
            inside = (high > high.new_tensor([left, top])) & (low < low.new_tensor([right, bottom]))
            index = inside.all(1).nonzero().squeeze(1)
            grid = torch.cartesian_prod(torch.arange(top, bottom), torch.arange(left, right)).to(centers)
            y, x = grid.unbind(1)
            u, v = centers.index_select(0, index).unbind(1)
            a, b, c = conics.index_select(0, index).unbind(1)
            dx, dy = x[:, None] + 0.5 - u, y[:, None] + 0.5 - v
            falloff = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            alpha = falloff * opacities.index_select(0, index)
            alpha = torch.where(alpha < 1 / 255, 0.0, alpha.clamp_max(0.999))
            after = torch.cumprod(1 - alpha, dim=1)
            before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
            yield order[index], torch.where(after > 1e-4, alpha * before, 0.0), (bottom - top, right - left)


def _splats(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Of all Gaussians in front of the camera, front to back: index, center, conic, opacity, extents."""
    rotation, offset = camera.view_matrix[:3, :3], camera.view_matrix[:3, 3]
    points = gaussians.means @ rotation.T + offset
    with torch.no_grad():
        order = ((points[:, 2] > 0.01) & (gaussians.opacities >= 1 / 255)).nonzero().squeeze(1)
        order = order[points[order, 2].argsort(stable=True)]
    opacities, (x, y, z) = gaussians.opacities[order], points[order].unbind(1)
    focal, center = camera.intrinsics.diagonal()[:2], camera.intrinsics[:2, 2]
    size = focal.new_tensor([camera.width, camera.height])
    slopes = torch.stack([x / z, y / z], dim=1)
    margin = 0.15 * size  # gsplat's: 0.3 of half the image, beyond which the affine approximation fails
    held = slopes.clamp((-center - margin) / focal, (size - center + margin) / focal)
    jacobian = torch.cat([torch.eye(2).to(held).expand(len(held), 2, 2), -held[:, :, None]], dim=2)
    jacobian = jacobian * (focal[:, None] / z[:, None, None])
    axes = jacobian @ rotation @ (_rotations(gaussians.quats[order]) * gaussians.scales[order, None])
    covariances = axes @ axes.mT + 0.3 * torch.eye(2).to(axes)
    (xx, xy), (_, yy) = (row.unbind(1) for row in covariances.unbind(1))
    conics = torch.stack([yy, -xy, xx], dim=1) / (xx * yy - xy * xy)[:, None]
    with torch.no_grad():
        reach = (2 * torch.log(255 * opacities)[:, None] * torch.stack([xx, yy], dim=1)).sqrt()
    return order, slopes * focal + center, conics, opacities, reach


def _rotations(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """R = I + 2w[v]ₓ + 2[v]ₓ² for the unit quaternion (w, v)."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).view(-1, 3, 3)
    return torch.eye(3).to(quats) + 2 * w[:, None, None] * cross + 2 * cross @ cross
