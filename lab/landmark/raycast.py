"""Ray casting from a camera, or from the sun, against a list of shapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int16
from numpy import ndarray as Array

from lab.landmark.shapes import MISS, NEAREST, Shape, Vector


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera with its principal point at the photo's center. The world is in meters, z up; the camera
    frame is x right, y down, z forward (COLMAP's)."""

    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    """Rotation from world to camera. The rows are right, down and forward."""
    focal: float
    """Focal length in units of the photo's longer side, so independent of resolution."""

    @classmethod
    def looking_at(cls, position, target, focal: float, roll: float = 0.0) -> Camera:
        """Build a camera at `position` that looks at `target`, upright except for the roll (radians)."""
        position = np.asarray(position, dtype=np.float64)
        forward = np.asarray(target, dtype=np.float64) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s = math.cos(roll), math.sin(roll)
        return cls(position, np.stack([c * right + s * down, c * down - s * right, forward]), focal)

    def project(self, points: Float[Array, "n 3"], width: int, height: int) -> Float[Array, "n 3"]:
        """Project world points to pixels x, y (origin at the corner of the top-left pixel) and depth."""
        x, y, z = self.rotation @ (points - self.position).T
        f = self.focal * max(width, height)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([f * x / z + width / 2, f * y / z + height / 2, z], axis=1)

    def rays(self, width: int, height: int) -> tuple[Vector, Vector]:
        """Return origin and directions through pixel centers. A unit along a ray is one meter of depth."""
        f = self.focal * max(width, height)
        right, down, forward = self.rotation.astype(np.float32)
        x = ((np.arange(width, dtype=np.float32) + 0.5 - width / 2) / f)[None, :]
        y = ((np.arange(height, dtype=np.float32) + 0.5 - height / 2) / f)[:, None]
        origin = self.position.astype(np.float32)
        direction = tuple(right[i] * x + down[i] * y + forward[i] for i in range(3))
        return (origin[0], origin[1], origin[2]), (direction[0], direction[1], direction[2])

    def screen_boxes(self, corners: Float[Array, "n 8 3"], width: int, height: int) -> tuple[Array, Array]:
        """Return pixels x0, y0, x1, y1 [n, 4] that the hulls may cover, and their smallest depths [n]."""
        x, y, z = self.project(corners.reshape(-1, 3), width, height).T.reshape(3, -1, 8)
        boxes, nearest = _pixel_boxes(x, y, width, height), z.min(axis=1)
        boxes[nearest < NEAREST] = 0, 0, width, height  # partly behind the camera: the whole picture
        boxes[z.max(axis=1) < NEAREST] = 0
        return boxes, nearest


@dataclass(frozen=True, eq=False)
class SunCamera:
    """Parallel rays from the sun onto a square of `extent` meters around `center`."""

    center: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    extent: float

    def project(self, points: Float[Array, "n 3"], width: int, height: int) -> Float[Array, "n 3"]:
        """Project world points to shadow map coordinates and the distance from the sun's plane in meters."""
        x, y, z = self.rotation.astype(np.float32) @ (points - self.center).astype(np.float32).T
        f = width / self.extent
        return np.stack([f * x + width / 2, f * y + height / 2, z + 2 * self.extent], axis=1)

    def rays(self, width: int, height: int) -> tuple[Vector, Vector]:
        right, down, forward = self.rotation.astype(np.float32)
        x = ((np.arange(width, dtype=np.float32) + 0.5 - width / 2) * (self.extent / width))[None, :]
        y = ((np.arange(height, dtype=np.float32) + 0.5 - height / 2) * (self.extent / width))[:, None]
        start = (self.center - 2 * self.extent * self.rotation[2]).astype(np.float32)
        origin = tuple(right[i] * x + down[i] * y + start[i] for i in range(3))
        return (origin[0], origin[1], origin[2]), (forward[0], forward[1], forward[2])

    def screen_boxes(self, corners: Float[Array, "n 8 3"], width: int, height: int) -> tuple[Array, Array]:
        """Return pixel boxes and smallest depths, as `Camera.screen_boxes` does."""
        x, y, z = self.project(corners.reshape(-1, 3), width, height).T.reshape(3, -1, 8)
        return _pixel_boxes(x, y, width, height), z.min(axis=1)


def cast(
    shapes: Sequence[Shape], camera: Camera | SunCamera, width: int, height: int
) -> tuple[Float[Array, "h w"], Int16[Array, "h w"]]:
    """Find depth (meters, MISS without a hit) and index of the nearest shape (-1 without a hit)."""
    origin, direction = camera.rays(width, height)
    depth = np.full((height, width), MISS, dtype=np.float32)
    index = np.full((height, width), -1, dtype=np.int16)
    boxes, nearest = camera.screen_boxes(np.stack([shape.corners for shape in shapes]), width, height)
    with np.errstate(all="ignore"):  # rays parallel to a face divide by zero and miss
        for i in np.argsort(nearest, kind="stable").tolist():  # nearest first, since they hide others
            x0, y0, x1, y1 = boxes[i].tolist()
            if x0 >= x1 or y0 >= y1:
                continue
            part = (slice(y0, y1), slice(x0, x1))
            if depth[part].max() < nearest[i]:
                continue
            shape = shapes[i]
            t = shape.distance(
                shape.point_to_local(_crop(origin, part)), shape.to_local(_crop(direction, part))
            )
            closer = t < depth[part]
            np.copyto(depth[part], t, where=closer, casting="same_kind")
            index[part][closer] = i
    return depth, index


def _crop(vector: Vector, part: tuple[slice, slice]) -> Vector:
    x, y, z = (v[part] if np.ndim(v) else v for v in vector)
    return x, y, z


def _pixel_boxes(x: Float[Array, "n 8"], y: Float[Array, "n 8"], width: int, height: int) -> Array:
    """Return x0, y0, x1, y1 around projected corners, with a pixel of margin, clipped to the picture."""
    box = np.stack([x.min(axis=1) - 1, y.min(axis=1) - 1, x.max(axis=1) + 2, y.max(axis=1) + 2], axis=1)
    return np.clip(np.nan_to_num(box), 0, [width, height, width, height]).astype(np.int64)
