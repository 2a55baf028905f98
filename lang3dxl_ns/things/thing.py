"""A thing of a scene, and the upright box around it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

OUTLIERS = 0.03
"""Share of a thing's weight that its box leaves out at either end of each axis."""

Box = tuple[Float[Array, "3"], Float[Array, "3 3"], Float[Array, "3"]]
"""Center, axes and size of an upright box, as `Thing` has them."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """Where a photo shows a thing."""

    photo: str
    box: tuple[int, int, int, int]
    """Left, top, right and bottom end in pixels of the training photo."""


@dataclass(frozen=True, eq=False, repr=False)
class Thing:
    """One thing: a window, a portal, a tower."""

    id: int
    """Index of its strongest Gaussian: one that is large, matches, and that many of its pieces show. So other
    words that find the same thing give it the same id, and nothing that was asked before changes it."""
    word: str
    """Prompt that found it."""
    score: float
    """Mean relevancy of its Gaussians, 0…1."""
    views: int
    """Number of photos that show it by itself."""
    center: Float[Array, "3"]
    """Center of its box in the model's frame."""
    axes: Float[Array, "3 3"]
    """Directions of the box's edges, one a row: two level ones, then up."""
    size: Float[Array, "3"]
    """Lengths of the edges, world units."""
    rows: Int[Array, " m"]
    """Indices of its Gaussians."""
    sightings: list[Sighting] = field(default_factory=list)
    """Photos that show it, the best first."""

    @property
    def best_photo(self) -> str:
        """Name of the photo that shows it best; empty if no photo does."""
        return self.sightings[0].photo if self.sightings else ""

    def __repr__(self) -> str:
        where, size = (tuple(v.round(3).tolist()) for v in (self.center, self.size))
        return f"Thing({self.id}, {self.word!r}, center {where}, size {size}, score {self.score:.2f})"

    def as_json(self) -> dict[str, Any]:
        """Return its description, without its Gaussians and photos, for JSON."""
        numbers = {name: getattr(self, name).round(5).tolist() for name in ("center", "axes", "size")}
        return {"id": self.id, "word": self.word, "score": round(self.score, 3), "views": self.views,
                **numbers, "gaussians": len(self.rows)}  # fmt: skip


def upright_box(points: Float[Array, "m 3"], weight: Float[Array, " m"], axes: Float[Array, "3 3"]) -> Box:
    """Find the box around weighted points along `axes`: unit vectors, one a row, of which the last is up."""
    ends = np.stack([_ends(along, weight) for along in (points @ axes.T).T])
    return ends.mean(1) @ axes, axes, ends[:, 1] - ends[:, 0]


def _ends(values: Float[Array, " m"], weight: Float[Array, " m"]) -> Float[Array, "2"]:
    order = values.argsort()
    below = (weight[order].cumsum() - weight[order] / 2) / weight.sum()
    return np.interp((OUTLIERS, 1 - OUTLIERS), below, values[order])
