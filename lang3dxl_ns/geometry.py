"""Frames and places: nerfstudio's cameras for the rasteriser, and a sky around the scene."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


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


def sphere_around(points: Float[Tensor, "n 3"], count: int) -> Float[Tensor, "count 3"]:
    """Evenly spread points (a Fibonacci lattice) on a sphere of ten times the scene's radius."""
    centre = points.median(dim=0).values
    radius = 10 * (points - centre).norm(dim=1).quantile(0.9)
    i = torch.arange(count) + 0.5
    z, longitude = 1 - 2 * i / count, i * math.pi * (3 - math.sqrt(5))
    around = (1 - z * z).sqrt()
    return centre + radius * torch.stack([around * longitude.cos(), around * longitude.sin(), z], dim=1)
