"""Extent of a scene: its center, its radius, and a sphere around it."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def center_and_radius(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3"], float]:
    """Compute the median point of a scene, and the radius around it that contains 90 % of the points."""
    center = points.median(dim=0).values
    return center, float((points - center).norm(dim=1).quantile(0.9))


def sphere_around(points: Float[Tensor, "n 3"], count: int) -> Float[Tensor, "count 3"]:
    """Spread points evenly (as a Fibonacci lattice) on a sphere of ten times the scene's radius."""
    center, radius = center_and_radius(points)
    i = torch.arange(count) + 0.5
    z, longitude = 1 - 2 * i / count, i * math.pi * (3 - math.sqrt(5))
    around = (1 - z * z).sqrt()
    return center + 10 * radius * torch.stack([around * longitude.cos(), around * longitude.sin(), z], dim=1)
