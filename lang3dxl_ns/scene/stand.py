"""Viewpoint of a photo for nerfstudio's viewer."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lang3dxl_ns.scene.camera import Camera


@dataclass(frozen=True)
class Stand:
    """Pose of the viewer's camera in the model's axes, z up; without roll, which its controls lack."""

    position: np.ndarray
    """Position, shape [3]."""
    look_at: np.ndarray
    """Orbit center, shape [3]."""
    fov: float
    """Vertical field of view, radians."""


def stand_of(camera: Camera, aspect: float, target: tuple[float, ...] | None = None) -> Stand:
    """Compute the viewpoint that shows all of a photo in a window of this aspect ratio (width ÷ height).
    `target` is the orbit center, which is moved onto the photo's axis at its distance; None puts it a unit
    away."""
    view = camera.view_matrix.double().cpu().numpy()
    forward, position = view[2, :3], -view[:3, :3].T @ view[:3, 3]
    ahead = 1.0 if target is None else float((np.asarray(target) - position) @ forward)
    k = camera.intrinsics.double().cpu().numpy()
    half_height = max(k[1, 2], camera.height - k[1, 2]) / k[1, 1]
    half_width = max(k[0, 2], camera.width - k[0, 2]) / k[0, 0]
    fov = 2 * math.atan(max(half_height, half_width / aspect))
    return Stand(position, position + max(ahead, 0.05) * forward, fov)
