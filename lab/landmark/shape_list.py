"""List of a landmark's solids and their materials, with the random choices of its builder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np

from lab.landmark.labels import PART
from lab.landmark.materials import Material
from lab.landmark.shapes import Box, Ellipsoid, Frustum, Polytope, Shape, gable, prism

Point = tuple[float, float, float]
Build = TypeVar("Build", bound=Callable[..., None])


def is_thing(build: Build) -> Build:
    """Decorate a function that builds one dome, tower, spire or minaret, so that its shapes are recorded."""

    @wraps(build)
    def recorded(b: ShapeList, *args: Any, **settings: Any) -> None:
        first = len(b.shapes)
        build(b, *args, **settings)
        part = build.__name__ if build.__name__ in PART else "spire"  # a pinnacle is a small spire
        b.things.append((part, range(first, len(b.shapes))))

    return cast(Build, recorded)


@dataclass
class ShapeList:
    """Collection of shapes and their materials."""

    rng: np.random.Generator
    shapes: list[Shape] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    role: dict[str, int] = field(default_factory=dict)
    """Index into `materials` by role: "wall", "trim", "dome" …"""
    things: list[tuple[str, range]] = field(default_factory=list)
    """Domes, towers, spires and minarets: the part, and the range of the shapes that building it added, of
    which those with this part belong to it."""

    def add_material(self, material: Material) -> int:
        self.materials.append(material)
        return len(self.materials) - 1

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def pick(self, *choices: str) -> str:
        return choices[int(self.rng.integers(len(choices)))]

    # Solids: `material` is a role, `foot` the center of the base.

    def box(self, part: str, material: str, foot: Point, size: Point, yaw: float = 0.0) -> None:
        self.shapes.append(Box(PART[part], self.role[material], foot, yaw, 0, size))

    def cone(self, part: str, material: str, foot: Point, bottom: float, top: float, height: float) -> None:
        self.shapes.append(Frustum(PART[part], self.role[material], foot, 0.0, 0, bottom, top, height))

    def ellipsoid(self, part: str, material: str, centre: Point, radii: Point, cut=-1e3, end=1e3) -> None:
        self.shapes.append(Ellipsoid(PART[part], self.role[material], centre, 0.0, 0, radii, cut, end))

    def gable(
        self, part: str, material: str, foot: Point, width: float, length: float, height: float, yaw=0.0
    ) -> None:
        """Add a gabled roof with its ridge along y (turned by yaw)."""
        fields = gable(width, length, height)
        self.shapes.append(Polytope(PART[part], self.role[material], foot, yaw, 0, **fields))

    def prism(self, part, material, foot: Point, radius, height, sides: int, taper=0.0, yaw=0.0) -> None:
        fields = prism(radius, height, sides, taper)
        self.shapes.append(Polytope(PART[part], self.role[material], foot, yaw, 0, **fields))
