"""Frame of training: the similarity that turns a capture upright, centers it and scales it to unit size."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray as Array

from lang3dxl_ns.scene.capture_settings import Center, Orientation

if TYPE_CHECKING:
    from lang3dxl_ns.scene.colmap import TrackedPhoto

COLMAP_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation from COLMAP's usual y down to z up."""
_LOST = 100
"""Distance, relative to the typical one, from which a camera is lost: it sees the scene in ten pixels."""
_MOST_LOST = 1 / 4
"""Largest share of cameras that can be lost. Where more stand apart, they are another part of the scene."""
_LEAST_ANGLE = 1e-3
"""Extent of all points, relative to their distance, below which they are a pixel of every photo."""
_OFF_CENTER = 0.2
"""Distance of a lens's center from the picture's, relative to its side, that hardly any camera has."""
_MOST_PROJECTED = 10_000
"""Number of points that tell whether a photo sees any."""
_PARALLEL = 0.17
"""Deviation of the cameras' right axes from a plane's normal (10 degrees) below which they are parallel."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Similarity x ↦ scale · (transform · x), in float64: map coordinates are in the millions."""

    transform: Float64[Array, "3 4"]
    """Rotation and translation that precede the scale."""
    scale: float

    def points(self, points: Float[Array, "n 3"]) -> Float64[Array, "n 3"]:
        """Transform points."""
        return self.scale * (points @ self.transform[:, :3].T + self.transform[:, 3])

    def poses(self, poses: Float[Array, "n 3 4"]) -> Float64[Array, "n 3 4"]:
        """Transform poses (camera → world, any camera axes); their axes keep unit length."""
        turned = self.transform[:, :3] @ poses[:, :, :3]
        return np.concatenate([turned, self.points(poses[:, :, 3])[..., None]], axis=2)

    def inverse(self) -> Frame:
        """Return the similarity back."""
        turn = np.linalg.inv(self.transform[:, :3])
        return Frame(np.column_stack([turn, -self.scale * turn @ self.transform[:, 3]]), 1 / self.scale)

    def after(self, rotation: Float[Array, "3 4"], scale: float) -> Frame:
        """Return the frame for coordinates to which another similarity of this form was applied first."""
        turn, shift = self.transform[:, :3] @ rotation[:, :3], self.transform[:, :3] @ rotation[:, 3]
        moved = shift + self.transform[:, 3] / scale
        return Frame(np.column_stack([turn, moved]), self.scale * scale)


def find_frame(
    poses: Float[Array, "n 3 4"],
    points: Float[Array, "m 3"],
    axes: Float[Array, "3 3"],
    orientation: Orientation = "up",
    center: Center = "poses",
    auto_scale: bool = True,
    factor: float = 1.0,
) -> Frame:
    """Choose the frame of training.

    Args:
        poses: camera → world, the world being the capture's; camera axes x right, y up, z backward.
        points: the capture's points, which tell whether the cameras stand apart.
        axes: rotation of the world to z up that is applied first.
        orientation: "up" turns the cameras' mean up axis to z; "vertical" turns the direction to z that is
            orthogonal to their right axes.
        center: the origin is the cameras' mean ("poses"), or the world's.
        auto_scale: whether the farthest coordinate of a camera becomes 1.
        factor: scale in addition.
    """
    origin = poses[:, :, 3].mean(axis=0)  # subtracted first, as the differences are small
    turned = axes @ np.concatenate([poses[:, :, :3], (poses[:, :, 3] - origin)[..., None]], axis=2)
    turn = _turn(turned, orientation)
    offsets, shift = turned[:, :, 3] @ turn.T, -turn @ axes @ origin
    if center == "none":
        offsets, shift = poses[:, :, 3] @ (turn @ axes).T, np.zeros(3)
    far = float(np.abs(offsets).max())
    scale = factor / far if auto_scale and far > 0 and _apart(poses[:, :, 3], points) else factor
    return Frame(np.column_stack([turn @ axes, shift]), scale)


def lost_cameras(centers: Float[Array, "n 3"], points: Float[Array, "m 3"]) -> Bool[Array, " n"]:
    """Return which cameras stand so far from the others and the points that their poses must be wrong."""
    middle = np.median(centers, axis=0)
    distances = np.linalg.norm(centers - middle, axis=1)
    to_points = np.median(np.linalg.norm(points - middle, axis=1)) if len(points) else 0.0
    extent = max(float(np.median(distances)), float(to_points))
    lost = distances > _LOST * extent
    few = len(centers) >= 4 and lost.sum() <= _MOST_LOST * len(centers)
    return lost if few and extent > 0 else np.zeros_like(lost)


def no_scene(centers: Float[Array, "n 3"], points: Float[Array, "m 3"]) -> str | None:
    """Tell why cameras and points can't be those of a scene; None if they can."""
    if len(centers) > 1 and not _apart(centers, points):
        return "all cameras stand in one place, from where photos show no depth"
    if len(points) > 1:
        middle = np.median(points, axis=0)
        far, wide = (np.median(np.linalg.norm(some - middle, axis=1)) for some in (centers, points))
        if wide < _LEAST_ANGLE * far:
            return f"the points lie {wide:.2g} units apart, {far:.2g} from the cameras, as in other units"
    return None


def wrong_cameras(photos: Collection[TrackedPhoto], points: Float[Array, "m 3"]) -> str | None:
    """Tell why most cameras can't be those of their photos; None if they can. Exporters confuse the
    directions of poses and of axes, and sizes of pictures."""
    away = [photo for photo in photos if abs(_center(photo) - 0.5).max() > _OFF_CENTER]
    if 2 * len(away) > len(photos):
        lens = away[0].lens
        return (
            f"the lenses of {len(away)} of {len(photos)} photos have their center far from the picture's, "
            f"as {away[0].name} at {lens.cx:.4g}, {lens.cy:.4g} of {lens.width} × {lens.height} pixels: "
            "focal lengths and centers may be those of pictures of another size"
        )
    points = points[:: 1 + len(points) // _MOST_PROJECTED]
    blind = [photo for photo in photos if len(points) > 1 and not _sees(photo, points)]
    if 2 * len(blind) > len(photos):
        return (
            f"{len(blind)} of {len(photos)} photos do not see the points, such as {blind[0].name}: poses may "
            "have the wrong direction (camera → world or world → camera) or axes, or points other "
            "coordinates than poses"
        )
    return None


def _center(photo: TrackedPhoto) -> Float64[Array, "2"]:
    lens = photo.lens
    return np.array([lens.cx / lens.width, lens.cy / lens.height])


def _sees(photo: TrackedPhoto, points: Float[Array, "m 3"]) -> bool:
    """Return whether half of a photo's tracked points, or without any one of these, lies in its view."""
    tracked, lens, view = len(photo.points) > 0, photo.lens, photo.camera_from_world
    x, y, z = view[:, :3] @ (photo.points if tracked else points).T + view[:, 3:]
    z = np.where(z > 0, z, np.nan)
    with np.errstate(over="ignore"):
        across, down = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
    near = (abs(across / lens.width - 0.5) < 1) & (abs(down / lens.height - 0.5) < 1)  # lenses may distort
    seen = z > 0 if lens.fisheye else near
    return bool(seen.mean() >= 0.5 if tracked else seen.any())


def _apart(centers: Float[Array, "n 3"], points: Float[Array, "m 3"]) -> bool:
    """Return whether cameras are far enough apart to scale the scene by their distance."""
    distances = np.linalg.norm(points - centers.mean(axis=0), axis=1)
    typical = np.median(distances) if len(distances) else 0.0
    return bool(np.ptp(centers, axis=0).max() > 1e-6 * typical)


def turned_to(direction: Float[Array, "3"], target: tuple[int, int, int]) -> Float64[Array, "3 3"]:
    """Compute the smallest rotation that takes a direction to another; the identity for a zero vector."""
    from scipy.spatial.transform import Rotation  # which opening a scene file does not need

    length = float(np.linalg.norm(direction))
    if length < 1e-12:
        return np.eye(3)
    return Rotation.align_vectors([target], [direction / length])[0].as_matrix()


def _turn(poses: Float[Array, "n 3 4"], orientation: Orientation) -> Float64[Array, "3 3"]:
    """Compute the rotation that turns the scene upright."""
    up, up_axis = poses[:, :, 1].mean(axis=0), (0, 0, 1)
    if orientation == "up":
        return turned_to(up, up_axis)
    if orientation == "vertical":
        _, sizes, axes = np.linalg.svd(poses[:, :, 0], full_matrices=True)
        if len(poses) > 1 and sizes[1] > _PARALLEL * np.sqrt(len(poses)):
            return turned_to(axes[2] * np.copysign(1.0, axes[2] @ up), up_axis)
        return turned_to(up - axes[0] * (axes[0] @ up), up_axis)
    return np.eye(3)
