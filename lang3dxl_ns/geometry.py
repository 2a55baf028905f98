"""Frames and places: nerfstudio's cameras for the rasteriser, what they see, and a sky around the scene."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.rendering import Camera


def view_matrix(camera_to_world: Float[Tensor, "3 4"]) -> Float[Tensor, "4 4"]:
    """World → camera (OpenCV axes) from nerfstudio's camera → world (OpenGL axes)."""
    rotation = (camera_to_world[:, :3] * camera_to_world.new_tensor([1.0, -1.0, -1.0])).T
    top = torch.cat([rotation, -rotation @ camera_to_world[:, 3:]], dim=1)
    return torch.cat([top, camera_to_world.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def camera_to_world(view_matrix: Float[Tensor, "4 4"]) -> Float[Tensor, "3 4"]:
    """The inverse of `view_matrix`: nerfstudio's camera → world from world → camera (OpenCV axes)."""
    rotation = view_matrix[:3, :3].T
    position = -rotation @ view_matrix[:3, 3:]
    return torch.cat([rotation * view_matrix.new_tensor([1.0, -1.0, -1.0]), position], dim=1)


@torch.no_grad()
def in_view(camera: Camera, means: Float[Tensor, "n 3"], scales: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Which Gaussians may show: none that does is missing, some that don't are among them.

    Holds the ball of 3.5 standard deviations around each against the planes through the image's edges.
    """
    points = means @ camera.view_matrix[:3, :3].T + camera.view_matrix[:3, 3]
    reach = 3.5 * scales.amax(dim=1)
    seen = points[:, 2] > 0
    margin = 8  # pixels: the rasteriser blurs every splat by one or two
    for axis, size in ((0, camera.width), (1, camera.height)):
        focal, middle = camera.intrinsics[axis, axis], camera.intrinsics[axis, 2]
        for side, edge in ((-1, middle + margin), (1, size + margin - middle)):
            outside = side * focal * points[:, axis] - edge * points[:, 2]
            seen &= outside <= reach * torch.hypot(focal, edge)
    return seen


def centre_and_radius(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3"], float]:
    """Middle of a scene, and the distance from it within which nine tenths of its points lie."""
    centre = points.median(dim=0).values
    return centre, float((points - centre).norm(dim=1).quantile(0.9))


def fitted_size(codes: Float[Tensor, "H W 3"], longer_side: int) -> tuple[int, int]:
    """Rows and columns of a map of at most `longer_side` pixels."""
    height, width = codes.shape[:2]
    scale = min(longer_side / max(height, width), 1.0)
    return max(round(height * scale), 1), max(round(width * scale), 1)


def resize_nearest(image: Float[Tensor, "H W c"], size: tuple[int, int]) -> Float[Tensor, "h w c"]:
    """Nearest-exact: picks samples, since averaging codes would make codes of nothing."""
    return F.interpolate(image.permute(2, 0, 1)[None], size, mode="nearest-exact")[0].permute(1, 2, 0)


def sphere_around(points: Float[Tensor, "n 3"], count: int) -> Float[Tensor, "count 3"]:
    """Evenly spread points (a Fibonacci lattice) on a sphere of ten times the scene's radius."""
    centre, radius = centre_and_radius(points)
    i = torch.arange(count) + 0.5
    z, longitude = 1 - 2 * i / count, i * math.pi * (3 - math.sqrt(5))
    around = (1 - z * z).sqrt()
    return centre + 10 * radius * torch.stack([around * longitude.cos(), around * longitude.sin(), z], dim=1)
