"""A procedural landmark: a seeded building of one of three families, with its surroundings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from lab.landmark.families import cathedral, hall, mosque
from lab.landmark.labels import BUILDING_PARTS, PARTS
from lab.landmark.materials import Material
from lab.landmark.shapes import Shape
from lab.landmark.surroundings import place_surroundings
from lab.landmark.vocabulary import Builder
from lang3dxl_ns.common.errors import UserError

_GRAMMARS = {"cathedral": cathedral, "mosque": mosque, "hall": hall}
FAMILIES = tuple(_GRAMMARS)


@dataclass(frozen=True, eq=False)
class Landmark:
    """Shapes and materials in meters, z up, the ground at z = 0, the façade facing +x."""

    seed: int
    family: str
    shapes: tuple[Shape, ...]
    materials: tuple[Material, ...]
    center: Float[Array, "3"]
    """Center of the building's bounds."""
    radius: float
    """Half the horizontal diagonal of the building's bounds, meters."""
    height: float
    """Height of the building, meters."""
    obstacles: Float[Array, "n 2 3"]
    """Bounds (lower and upper corner) of everything but the ground, which keep cameras and people out."""
    things: tuple[tuple[str, range], ...] = ()
    """Part and range of shapes of every dome, tower, spire and minaret, see `ShapeList.things`."""
    weathered: bool = False
    """Whether walls and windows have stains and grain of their own, see `weathering`."""

    @classmethod
    def from_seed(cls, seed: int, family: str | None = None, weathered: bool = False) -> Landmark:
        """Build the landmark of this seed, which also chooses the family if it is None or "auto".

        Raises UserError for an unknown family.
        """
        rng = np.random.default_rng([seed, 1])
        drawn = FAMILIES[int(rng.integers(len(FAMILIES)))]
        family = drawn if family in (None, "auto") else family
        if family not in _GRAMMARS:
            raise UserError(f"there is no landmark family {family!r}: choose one of {', '.join(FAMILIES)}")
        builder = Builder(rng)
        _GRAMMARS[family](builder)
        low, high = _bounds(shape for shape in builder.shapes if PARTS[shape.part] in BUILDING_PARTS)
        center, radius = (low + high) / 2, math.hypot(*(high - low)[:2]) / 2
        place_surroundings(builder, center, radius)
        standing = [_bounds([shape]) for shape in builder.shapes if PARTS[shape.part] != "ground"]
        return cls(
            seed=seed, family=family, shapes=tuple(builder.shapes), materials=tuple(builder.materials),
            center=center, radius=radius, height=float(high[2]), obstacles=np.array(standing),
            things=tuple(builder.things), weathered=weathered,
        )  # fmt: skip

    def is_free(self, point, margin: float) -> bool:
        """Return whether nothing is within `margin` meters of a point (by bounding boxes)."""
        low, high = self.obstacles[:, 0], self.obstacles[:, 1]
        point = np.asarray(point)
        return not ((point > low - margin) & (point < high + margin)).all(axis=1).any()


def _bounds(shapes) -> tuple[Array, Array]:
    corners = np.concatenate([shape.corners for shape in shapes])
    return corners.min(axis=0), corners.max(axis=0)
