"""The box of `scenes.write_scene` as a splat: what a perfect trainer would make of its photos.

from box_splat import box_splat
"""

from __future__ import annotations

import numpy as np
import torch
from scenes import CENTER, HALF_SIZES, texture

from lang3dxl_ns.rendering import Splats, harmonics_of


def box_splat(spacing: float = 0.05, ground: bool = False) -> Splats:
    """A flat Gaussian for every square of the box's faces, and of the ground around it."""
    rows = [_face(axis, side, spacing) for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1), (2, 1))]
    if ground:
        ticks = np.arange(-3, 3, 2 * spacing)
        plane = np.array([[x, y, 0.0] for x in ticks for y in ticks])
        outside = (np.abs(plane[:, :2]) > HALF_SIZES[:2]).any(axis=1)
        rows.append((plane[outside], 2, 2 * spacing))
    means = np.concatenate([points for points, _, _ in rows])
    scales = np.concatenate([_flat(axis, size, len(points)) for points, axis, size in rows])
    count = len(means)
    return Splats(
        torch.from_numpy(means).float(),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.from_numpy(scales).float(),
        torch.full((count,), 0.95),
        harmonics_of(torch.from_numpy(texture(means)).float()),
    )


def _face(axis: int, side: int, spacing: float):
    others = [i for i in range(3) if i != axis]
    ticks = [np.arange(spacing / 2, 2 * HALF_SIZES[i], spacing) - HALF_SIZES[i] for i in others]
    points = np.zeros((len(ticks[0]) * len(ticks[1]), 3))
    points[:, others[0]], points[:, others[1]] = (grid.ravel() for grid in np.meshgrid(*ticks))
    points[:, axis] = side * HALF_SIZES[axis]
    return CENTER + points, axis, spacing


def _flat(axis: int, size: float, count: int) -> np.ndarray:
    scales = np.full((count, 3), size / 2)
    scales[:, axis] = 1e-3
    return scales
