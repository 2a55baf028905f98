"""Places in 3D: boxes around matching Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

_OUTLIERS = 0.02
"""Share of a match's points that its box excludes at either end of each axis."""
STRONG = 0.5
"""Fraction of the way from the threshold to the highest relevancy from which Gaussians are the match."""
_CORE = 0.002
"""Share of a match's weight that a neighborhood must hold to belong to a group."""
_MOST_POINTS = 20_000
"""Most Gaussians that are grouped, the heaviest ones: DBSCAN keeps all their neighborhoods in memory."""


@dataclass(frozen=True, repr=False)
class Box:
    """An axis-aligned box in the model's frame."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    share: float
    """Share of the total match weight that this box's group holds, 0…1."""

    def __repr__(self) -> str:
        low, high = (tuple(round(x, 3) for x in corner) for corner in (self.low, self.high))
        return f"Box({low} to {high}, {self.share:.0%} of the match)"

    @property
    def center(self) -> tuple[float, ...]:
        """Center of the box."""
        return tuple((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))


def strongest_match(
    means: Float[Tensor, "n 3"],
    scores: Float[Tensor, " n"],
    mass: Float[Tensor, " n"],
    threshold: float,
    gap: float,
) -> Box | None:
    """Find the box of the connected Gaussians that match best; None if none does.

    Only Gaussians more than half-way from the threshold to the best count, so that weaker matches beside the
    strongest don't widen its box. DBSCAN separates groups that are more than `gap` world units apart.

    scores: relevancy of each Gaussian, 0…1. mass: pixels that each Gaussian fills, over all views.
    """
    weights = (scores - threshold).clamp_min(0) * mass
    rows = (weights > 0).nonzero().squeeze(1)
    if not len(rows):
        return None
    level = threshold + STRONG * (_high(scores[rows], mass[rows]) - threshold)
    strong = rows[scores[rows] >= level]
    return max(groups(means[strong], weights[strong], gap), key=lambda box: box.share)


def groups(means: Float[Tensor, "n 3"], weight: Float[Tensor, " n"], gap: float) -> list[Box]:
    """Group points (at least one, of weights above 0), each within `gap` world units of others of its group,
    and return the groups' boxes."""
    heaviest = weight.argsort(descending=True)[:_MOST_POINTS]
    points, share = means[heaviest].double().cpu().numpy(), weight[heaviest].double().cpu().numpy()
    from sklearn.cluster import DBSCAN  # imported here, since the import takes a second

    found = DBSCAN(eps=gap, min_samples=1).fit_predict(points, sample_weight=share / (share.sum() * _CORE))
    if (found < 0).all():  # no place is dense: take the heaviest Gaussian
        found = np.where(np.arange(len(found)) == share.argmax(), 0, -1)
    totals = np.bincount(found[found >= 0], weights=share[found >= 0]) / share.sum()
    boxes = []
    for i, total in enumerate(totals.tolist()):
        ends = np.quantile(points[found == i], (_OUTLIERS, 1 - _OUTLIERS), axis=0, method="nearest")
        low, high = map(tuple, ends.tolist())
        boxes.append(Box(low, high, total))
    return boxes


def _high(scores: Float[Tensor, " n"], mass: Float[Tensor, " n"]) -> float:
    """Return the relevancy that 2 % of the matching mass exceed: the highest, apart from stray Gaussians."""
    order = scores.argsort(descending=True)
    share = mass[order].cumsum(0) / mass.sum()
    return float(scores[order][int((share < _OUTLIERS).sum().clamp_max(len(order) - 1))])
