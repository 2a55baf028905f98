"""Scenes of the rasterizer benchmark: Gaussians by two recipes over a real or synthetic point cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.rendering import Gaussians
from lang3dxl_ns.scene.camera import Camera

Recipe = Literal["A", "B"]
CHANNELS, COLORS = 6, 3


@dataclass(frozen=True)
class Case:
    """One row of the report: number and kind of Gaussians, image size."""

    recipe: Recipe
    gaussians: int
    width: int
    height: int


@dataclass
class Problem:
    """Inputs of one rendering and its backward pass; gradients are computed for `leaves`."""

    gaussians: Gaussians
    camera: Camera
    channels: Float[Tensor, "n 6"]
    background: Float[Tensor, " 6"]
    image_gradient: Float[Tensor, "h w 6"]
    alpha_gradient: Float[Tensor, "h w 1"]

    @property
    def leaves(self) -> tuple[Tensor, ...]:
        g = self.gaussians
        return g.means, g.quats, g.scales, g.opacities, self.channels


def make_problem(
    case: Case, scene: Path | None, device: str = "cpu", dtype: torch.dtype = torch.float32, seed: int = 0
) -> Problem:
    """The same problem for the same case and seed, on any device and in any number type.

    Recipe A: random scales U(1e-4, 0.02), opacities U(0, 1). Recipe B, as in training: scales of the mean
    distance to the three nearest neighbors times a log-normal factor per axis, opacities sigmoid(N(0, 2)).
    """
    generator = torch.Generator().manual_seed(seed)
    points, camera = synthetic_cloud(case.gaussians, generator) if scene is None else load_cloud(scene)
    if len(points) < case.gaussians:
        raise UserError(
            f"{scene} has {len(points)} points within ±2, fewer than {case.gaussians}: lower --gaussians"
        )
    n = case.gaussians
    means = points[torch.randperm(len(points), generator=generator)[:n]]
    if case.recipe == "A":
        scales = torch.rand(n, 3, generator=generator) * (0.02 - 1e-4) + 1e-4
        opacities = torch.rand(n, generator=generator)
    else:
        scales = _neighbor_distance(means)[:, None] * torch.randn(n, 3, generator=generator).mul(0.5).exp()
        opacities = torch.sigmoid(2 * torch.randn(n, generator=generator))
    quats = torch.randn(n, 4, generator=generator)
    channels = torch.rand(n, CHANNELS, generator=generator)
    background = torch.rand(CHANNELS, generator=generator)
    image_gradient = torch.randn(case.height, case.width, CHANNELS, generator=generator)
    alpha_gradient = torch.randn(case.height, case.width, 1, generator=generator)

    def leaf(tensor: Tensor) -> Tensor:
        return tensor.to(device, dtype).requires_grad_()

    zoom = torch.tensor([case.width / camera.width, case.height / camera.height, 1.0])
    return Problem(
        Gaussians(leaf(means), leaf(quats), leaf(scales), leaf(opacities)),
        Camera(
            camera.view_matrix.to(device, dtype),
            (zoom[:, None] * camera.intrinsics).to(device, dtype),
            case.width,
            case.height,
        ),
        leaf(channels),
        background.to(device, dtype),
        image_gradient.to(device, dtype),
        alpha_gradient.to(device, dtype),
    )


def load_cloud(path: Path) -> tuple[Float[Tensor, "n 3"], Camera]:
    """Points within ±2 and the first camera of an npz in the layout of gsplat's `test_garden.npz`."""
    try:
        with np.load(path) as arrays:
            points = torch.from_numpy(arrays["means3d"]).float()
            view, intrinsics = (torch.from_numpy(arrays[name][0]).float() for name in ("viewmats", "Ks"))
            width, height = int(arrays["width"]), int(arrays["height"])
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"{path} is not a scene for this benchmark ({error}): give an npz with means3d, viewmats, Ks, "
            "width and height, as gsplat's test_garden.npz; without --scene a synthetic one is used"
        ) from error
    return points[points.abs().amax(1) < 2], Camera(view, intrinsics, width, height)


def synthetic_cloud(count: int, generator: torch.Generator) -> tuple[Float[Tensor, "n 3"], Camera]:
    """Points within ±2 on a ground, a round table, a ball on it and a round wall, seen from 1.6 away.

    A substitute for the garden, with about the same number of pixel–Gaussian pairs (within a quarter).
    """

    def uniform(n: int, *ranges: tuple[float, float]) -> list[Tensor]:
        return [low + (high - low) * torch.rand(n, generator=generator) for low, high in ranges]

    turn = (0.0, 2 * torch.pi)
    ground, table, ball = (count * percent // 100 for percent in (30, 40, 10))
    x, y, z = uniform(ground, (-2, 2), (-2, 2), (-0.72, -0.7))
    area, angle, level = uniform(table, (0, 0.64), turn, (-0.01, 0.01))
    bearing, height, distance = uniform(count - ground - table - ball, turn, (-0.7, 1), (1.75, 1.85))
    sphere = torch.nn.functional.normalize(torch.randn(ball, 3, generator=generator), dim=1)
    points = [
        torch.stack([x, y, z], dim=1),
        torch.stack([area.sqrt() * angle.cos(), area.sqrt() * angle.sin(), level], dim=1),
        0.25 * sphere + torch.tensor([0, 0, 0.25]),
        torch.stack([distance * bearing.cos(), distance * bearing.sin(), height], dim=1),
    ]
    return torch.cat(points), _camera_towards_origin(torch.tensor([-1.4, -0.3, 0.7]))


def _camera_towards_origin(position: Float[Tensor, " 3"]) -> Camera:
    """A camera of 648×420 pixels (like the garden's) at a world position; the world's z points up."""
    forward = -position / position.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]))
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    view = torch.eye(4)
    view[:3, :3], view[:3, 3] = rotation, -rotation @ position
    return Camera(view, torch.tensor([[480.0, 0, 324], [0, 480.0, 210], [0, 0, 1]]), 648, 420)


def _neighbor_distance(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Mean distance to the three nearest other points."""
    from scipy.spatial import KDTree

    array = points.numpy()
    distances, _ = KDTree(array).query(array, k=min(4, len(array)))
    return torch.from_numpy(distances[:, 1:].mean(1)).float().clamp_min(1e-6)
