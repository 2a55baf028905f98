"""A procedural landmark: a building of one of three families from a seed, and what stands around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from lang3dxl_ns.demo.families import cathedral, hall, mosque
from lang3dxl_ns.demo.labels import BUILDING_PARTS, PARTS
from lang3dxl_ns.demo.materials import Material
from lang3dxl_ns.demo.shapes import Shape
from lang3dxl_ns.demo.surroundings import place_surroundings
from lang3dxl_ns.demo.vocabulary import Builder
from lang3dxl_ns.errors import UserError

_GRAMMARS = {"cathedral": cathedral, "mosque": mosque, "hall": hall}
FAMILIES = tuple(_GRAMMARS)


@dataclass(frozen=True, eq=False)
class Landmark:
    """Shapes and materials in metres, z up, the ground at z = 0, the façade facing +x."""

    seed: int
    family: str
    shapes: tuple[Shape, ...]
    materials: tuple[Material, ...]
    centre: Float[Array, "3"]
    """Middle of the building's bounds."""
    radius: float
    """Half the horizontal diagonal of the building's bounds, metres."""
    height: float
    """Of the building, metres."""
    obstacles: Float[Array, "n 2 3"]
    """Lower and upper corners of everything but the ground: no camera or person stands in there."""

    @classmethod
    def from_seed(cls, seed: int, family: str | None = None) -> Landmark:
        """The landmark of this seed; without a family (or with "auto") the seed chooses that too.

        Raises UserError for a family that there isn't.
        """
        rng = np.random.default_rng([seed, 1])
        drawn = FAMILIES[int(rng.integers(len(FAMILIES)))]
        family = drawn if family in (None, "auto") else family
        if family not in _GRAMMARS:
            raise UserError(
                f"there is no family {family!r} of landmarks: choose one of {', '.join(FAMILIES)}"
            )
        builder = Builder(rng)
        _GRAMMARS[family](builder)
        low, high = _bounds(shape for shape in builder.shapes if PARTS[shape.part] in BUILDING_PARTS)
        centre, radius = (low + high) / 2, math.hypot(*(high - low)[:2]) / 2
        place_surroundings(builder, centre, radius)
        standing = [_bounds([shape]) for shape in builder.shapes if PARTS[shape.part] != "ground"]
        return cls(
            seed=seed,
            family=family,
            shapes=tuple(builder.shapes),
            materials=tuple(builder.materials),
            centre=centre,
            radius=radius,
            height=float(high[2]),
            obstacles=np.array(standing),
        )

    def is_free(self, point, margin: float) -> bool:
        """Whether nothing stands within `margin` metres of a point (bounding boxes are compared)."""
        low, high = self.obstacles[:, 0], self.obstacles[:, 1]
        point = np.asarray(point)
        return not ((point > low - margin) & (point < high + margin)).all(axis=1).any()


def _bounds(shapes) -> tuple[Array, Array]:
    corners = np.concatenate([shape.corners for shape in shapes])
    return corners.min(axis=0), corners.max(axis=0)
