"""Ray-cast solids: boxes, convex polytopes, frusta and ellipsoids.

Lengths are in meters, and z is up. A vector is a tuple (x, y, z) of arrays that broadcast: the rays of a
pinhole camera share an origin, and those of the sun share a direction. A shape's `position` is its foot.
`yaw` turns it about z.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

Vector = tuple[Any, Any, Any]
"""Vector as three float32 arrays of one shape, or as floats."""

NEAREST = 0.05
"""Distance in meters below which hits along the ray are ignored."""
MISS = np.float32(1e9)


@dataclass(frozen=True, eq=False)
class Surface:
    """Shading inputs at visible points, in the shape's own frame."""

    normal: Vector
    s: np.ndarray
    """Texture coordinate along the surface, horizontal; meters."""
    t: np.ndarray
    """Texture coordinate up the surface; meters."""
    shade: Any = 1.0
    """Factor on all light, which darkens corners."""
    sunlit: Any = 1.0
    """Factor on sunlight, for recesses in their own shadow."""
    trim: Any = False
    """True where the surface has the shape's `trim` material instead of its `material`."""
    element: Any = True
    """True where the shape's element applies. The stone surround of a window is not a window."""
    copy: Any = 0
    """Number of the exact copy within the shape: the side of a solid, the window of a row."""


@dataclass(frozen=True, eq=False)
class Shape(ABC):
    """Solid with its labels and its material (an index into the landmark's materials)."""

    part: int
    """Index into PARTS."""
    material: int
    position: tuple[float, float, float]
    yaw: float
    element: int
    """Index into ELEMENTS."""

    casts_shadow = True

    @property
    def trim(self) -> int:
        """Second material, if a surface has one."""
        return self.material

    @property
    @abstractmethod
    def bounds(self) -> tuple[float, float, float, float, float, float]:
        """Bounds x0, y0, z0, x1, y1, z1 in the shape's frame."""

    @abstractmethod
    def distance(self, origin: Vector, direction: Vector) -> np.ndarray:
        """Return the ray parameter of the first hit, in direction lengths, or MISS, in the local frame."""

    @abstractmethod
    def surface(self, point: Vector, direction: Vector, sun: Vector) -> Surface:
        """Return normal and texture at surface points, seen along `direction`, in the local frame."""

    @cached_property
    def corners(self) -> np.ndarray:
        """Eight corners of the bounds in world coordinates, [8, 3] float64."""
        bounds = self.bounds
        local = np.array([[bounds[x], bounds[y], bounds[z]] for x in (0, 3) for y in (1, 4) for z in (2, 5)])
        return np.stack(self.to_world(tuple(local.T)), axis=1) + self.position

    def to_local(self, vector: Vector) -> Vector:
        """Rotate a world direction to the shape's frame."""
        return _turn(vector, -self.yaw)

    def to_world(self, vector: Vector) -> Vector:
        """Rotate a local direction to the world's frame."""
        return _turn(vector, self.yaw)

    def point_to_local(self, point: Vector) -> Vector:
        """Transform a world point to the shape's frame."""
        x, y, z = self.position
        return self.to_local((point[0] - x, point[1] - y, point[2] - z))


@dataclass(frozen=True, eq=False)
class Box(Shape):
    """Box of `size` (x, y, z), positioned at the center of its base."""

    size: tuple[float, float, float]

    @property
    def bounds(self) -> tuple[float, float, float, float, float, float]:
        x, y, z = self.size
        return -x / 2, -y / 2, 0.0, x / 2, y / 2, z

    def distance(self, origin: Vector, direction: Vector) -> np.ndarray:
        bounds = self.bounds
        enter, leave = np.float32(NEAREST), MISS
        for axis in range(3):
            inverse = 1 / direction[axis]
            a, b = (bounds[axis] - origin[axis]) * inverse, (bounds[axis + 3] - origin[axis]) * inverse
            enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
        return np.where((enter < leave) & (enter > NEAREST), enter, MISS)

    def surface(self, point: Vector, direction: Vector, sun: Vector) -> Surface:
        x, y, z = point
        sx, sy, sz = self.size
        # The face is the one whose plane is nearest.
        gaps = np.stack([sx / 2 - np.abs(x), sy / 2 - np.abs(y), np.minimum(np.abs(z), np.abs(sz - z))])
        axis = np.abs(gaps).argmin(axis=0)
        normal = (
            np.where(axis == 0, np.sign(x), 0.0),
            np.where(axis == 1, np.sign(y), 0.0),
            np.where(axis == 2, np.where(z > sz / 2, 1.0, -1.0), 0.0),
        )
        side = 2 * axis + (np.choose(axis, (x, y, z - sz / 2)) > 0)
        return Surface(normal, np.where(axis == 0, y, x), np.where(axis == 2, y, z), copy=side)


@dataclass(frozen=True, eq=False)
class Polytope(Shape):
    """Convex solid of the points with normals · p ≤ offsets."""

    normals: np.ndarray
    offsets: np.ndarray
    box: tuple[float, float, float, float, float, float]

    @property
    def bounds(self) -> tuple[float, float, float, float, float, float]:
        return self.box

    def distance(self, origin: Vector, direction: Vector) -> np.ndarray:
        enter: np.ndarray | np.float32 = np.float32(NEAREST)
        leave: np.ndarray | np.float32 = MISS
        for (nx, ny, nz), offset in zip(self.normals.tolist(), self.offsets.tolist(), strict=True):
            slope = nx * direction[0] + ny * direction[1] + nz * direction[2]
            t = (offset - (nx * origin[0] + ny * origin[1] + nz * origin[2])) / slope
            enter = np.where(slope < 0, np.maximum(enter, t), enter)
            leave = np.where(slope < 0, leave, np.minimum(leave, t))
        return np.where((enter < leave) & (enter > NEAREST), enter, MISS)

    def surface(self, point: Vector, direction: Vector, sun: Vector) -> Surface:
        x, y, z = point
        planes = zip(self.normals.tolist(), self.offsets.tolist(), strict=True)
        gaps = np.stack([np.abs(nx * x + ny * y + nz * z - offset) for (nx, ny, nz), offset in planes])
        side = gaps.argmin(axis=0)
        nx, ny, nz = self.normals[side].T
        flat = np.abs(nz) > 0.98
        horizontal = np.maximum(np.hypot(nx, ny), 1e-6)
        s = np.where(flat, x, (y * nx - x * ny) / horizontal)
        return Surface((nx, ny, nz), s, np.where(flat, y, z / horizontal), copy=side)


@dataclass(frozen=True, eq=False)
class Frustum(Shape):
    """Closed cone or cylinder about z, with radius `bottom` at the foot and `top` at `height`."""

    bottom: float
    top: float
    height: float

    @property
    def bounds(self) -> tuple[float, float, float, float, float, float]:
        r = max(self.bottom, self.top)
        return -r, -r, 0.0, r, r, self.height

    def distance(self, origin: Vector, direction: Vector) -> np.ndarray:
        (ox, oy, oz), (dx, dy, dz) = origin, direction
        slope = (self.top - self.bottom) / self.height
        radius, shrink = self.bottom + slope * oz, slope * dz
        a = dx * dx + dy * dy - shrink * shrink
        b = ox * dx + oy * dy - shrink * radius
        c = ox * ox + oy * oy - radius * radius
        root = np.sqrt(b * b - a * c)  # NaN without a hit, which makes every comparison below false
        best = np.full(np.shape(root), MISS)
        for t in ((-b - root) / a, (-b + root) / a):
            z = oz + t * dz
            hit = (t > NEAREST) & (z >= 0) & (z <= self.height) & (self.bottom + slope * z >= 0) & (t < best)
            best = np.where(hit, t, best)
        for z, radius in ((0.0, self.bottom), (self.height, self.top)):
            if radius > 0:
                t = (z - oz) / dz
                hit = (t > NEAREST) & (t < best) & (np.hypot(ox + t * dx, oy + t * dy) <= radius)
                best = np.where(hit, t, best)
        return best

    def surface(self, point: Vector, direction: Vector, sun: Vector) -> Surface:
        x, y, z = point
        slope = (self.top - self.bottom) / self.height
        side = np.abs(np.hypot(x, y) - (self.bottom + slope * z))
        cap = np.minimum(np.abs(z), np.abs(self.height - z)) < side * 0.9
        r = np.maximum(np.hypot(x, y), 1e-6)
        n = 1 / math.hypot(1, slope)
        normal = (
            np.where(cap, 0.0, x / r * n),
            np.where(cap, 0.0, y / r * n),
            np.where(cap, np.where(z > self.height / 2, 1.0, -1.0), -slope * n),
        )
        around = np.arctan2(y, x) * max(self.bottom, self.top)
        return Surface(normal, np.where(cap, x, around), np.where(cap, y, z))


@dataclass(frozen=True, eq=False)
class Ellipsoid(Shape):
    """Open ellipsoid centered on its position, without the parts below z = `cut` and above z = `end`."""

    radii: tuple[float, float, float]
    cut: float
    end: float

    @property
    def bounds(self) -> tuple[float, float, float, float, float, float]:
        x, y, z = self.radii
        return -x, -y, max(self.cut, -z), x, y, min(self.end, z)

    def distance(self, origin: Vector, direction: Vector) -> np.ndarray:
        (ox, oy, oz), (dx, dy, dz) = (
            tuple(v / r for v, r in zip(vector, self.radii, strict=True)) for vector in (origin, direction)
        )
        a = dx * dx + dy * dy + dz * dz
        b = ox * dx + oy * dy + oz * dz
        root = np.sqrt(b * b - a * (ox * ox + oy * oy + oz * oz - 1))
        best = np.full(np.shape(root), MISS)
        for t in ((-b - root) / a, (-b + root) / a):
            z = origin[2] + t * direction[2]
            best = np.where((t > NEAREST) & (z >= self.cut) & (z <= self.end) & (t < best), t, best)
        return best

    def surface(self, point: Vector, direction: Vector, sun: Vector) -> Surface:
        x, y, z = (v / r for v, r in zip(point, self.radii, strict=True))
        normal = tuple(v / r for v, r in zip((x, y, z), self.radii, strict=True))
        length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        around = np.arctan2(y, x) * self.radii[0]
        up = np.arcsin(np.clip(z, -1, 1)) * self.radii[2]
        return Surface((normal[0] / length, normal[1] / length, normal[2] / length), around, up)


def floats(values: Any) -> np.ndarray:
    """Convert values to a float32 array."""
    return np.asarray(values, dtype=np.float32)


def gable(width: float, length: float, height: float) -> dict[str, Any]:
    """Compute the polytope fields of a gabled roof with its ridge along y and `width` along x."""
    tilt = math.hypot(height, width / 2)
    up, out = width / 2 / tilt, height / tilt
    normals = floats([[out, 0, up], [-out, 0, up], [0, 1, 0], [0, -1, 0], [0, 0, -1]])
    offsets = floats([out * width / 2, out * width / 2, length / 2, length / 2, 0])
    return {
        "normals": normals,
        "offsets": offsets,
        "box": (-width / 2, -length / 2, 0.0, width / 2, length / 2, height),
    }


def prism(radius: float, height: float, sides: int, taper: float = 0.0) -> dict[str, Any]:
    """Compute the polytope fields of an upright prism of inner `radius`. A taper of 1 makes it a pyramid."""
    angles = np.arange(sides) * 2 * math.pi / sides
    slope = radius * taper / height
    length = math.hypot(1, slope)
    sloped = np.stack(
        [np.cos(angles) / length, np.sin(angles) / length, np.full(sides, slope / length)], axis=1
    )
    outer = radius / math.cos(math.pi / sides)
    return {
        "normals": floats([*sloped, [0, 0, 1], [0, 0, -1]]),
        "offsets": floats([radius / length] * sides + [height, 0]),
        "box": (-outer, -outer, 0.0, outer, outer, height),
    }


def _turn(vector: Vector, angle: float) -> Vector:
    if angle == 0:
        return vector
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = vector
    return c * x - s * y, s * x + c * y, z
