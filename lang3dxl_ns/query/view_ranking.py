"""Where a match is: boxes around matching Gaussians, and views that show them, without rendering these."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.query.visibility import VisibleGaussians
from lang3dxl_ns.scene.camera import Camera, projected

OUTLIERS = 0.02
"""Share of a match's points that its box excludes at either end of each axis."""
STRONG = 0.5
"""Fraction of the way from the threshold to the highest relevancy from which Gaussians are the match."""
CORE = 0.9
"""The same for the core of the match that a box is drawn around."""
JOINED = 2.0
"""Factor by which a group may exceed its core; a larger one joins several things, as spire and tower."""
PEAK = 1e-3
"""Share of a view over which its peak is averaged, so that one stray Gaussian does not decide."""
LARGE = 0.2
"""Share of a view above which larger matches score no higher."""
RIM = 0.25
"""Weight of a match at a view's rim, where it is likely cut off; it is 1 in the middle half."""
DENSE = 0.002
"""Share of a match's weight that a neighborhood must hold to belong to a group."""
_MOST_POINTS = 20_000
"""Most Gaussians that are grouped, the heaviest ones."""
_CELL = 1 / 8
"""Side of the cells in which Gaussians are grouped as one, relative to the gap between groups."""


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the model's frame."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    share: float
    """Share of the total match weight that this box's group holds, 0…1."""

    @property
    def center(self) -> tuple[float, ...]:
        """Center of the box."""
        return tuple((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A training camera that shows a match."""

    name: str
    """Name of the training photo."""
    camera: Camera = field(repr=False)
    area: float
    """Share of the view that matches."""
    score: float
    """Mean relevancy of the most relevant thousandth of the view."""
    rank: float
    """How well the view shows the match, 0…1: closeness to the scene's highest peak × size × centering."""
    shown: bool
    """Whether the match fills at least one pixel."""


def strongest_match(
    means: Float[Tensor, "n 3"],
    scores: Float[Tensor, " n"],
    mass: Float[Tensor, " n"],
    threshold: float,
    gap: float,
) -> Box | None:
    """Find the box of the connected Gaussians that match best; None if none does.

    The core is the heaviest group of Gaussians that match nearly as well as the best. The box holds the group
    of good matches around it, or the core alone if the group joins it with other things. DBSCAN separates
    groups that are more than `gap` world units apart. `scores` is the relevancy of each Gaussian, 0…1; `mass`
    the pixels that it fills, over all views.
    """
    weights = (scores - threshold).clamp_min(0) * mass
    rows = (weights > 0).nonzero().squeeze(1)
    if not len(rows):
        return None
    # The highest relevancy apart from stray Gaussians: 2 % of the matching mass exceed it.
    order = rows[scores[rows].argsort(descending=True)]
    beyond = (mass[order].cumsum(0) < OUTLIERS * mass[order].sum()).sum()
    best = scores[order[beyond.clamp_max(len(order) - 1)]]

    def things(closeness: float) -> list[Box]:
        near = rows[scores[rows] >= threshold + closeness * (best - threshold)]
        return groups(means[near], weights[near], gap)

    core = max(things(CORE), key=lambda box: box.share)
    around = max(things(STRONG), key=lambda box: shared_volume(box, core, gap))
    one_thing = shared_volume(around, around, gap) <= JOINED * shared_volume(core, core, gap)
    return around if one_thing else core


def shared_volume(a: Box, b: Box, margin: float = 0.0) -> float:
    """Compute the volume of two boxes' intersection, widened so that points have volumes too."""
    return float(np.prod((np.minimum(a.high, b.high) - np.maximum(a.low, b.low) + margin).clip(0)))


def groups(means: Float[Tensor, "n 3"], weight: Float[Tensor, " n"], gap: float) -> list[Box]:
    """Return boxes of groups of points (one or more, of weights above 0) that lie `gap` world units apart."""
    heaviest = weight.argsort(descending=True)[:_MOST_POINTS]
    points, share = means[heaviest].double().cpu().numpy(), weight[heaviest].double().cpu().numpy()
    from sklearn.cluster import DBSCAN  # imported here, since the import takes a second

    # Gaussians in one cell count as one. DBSCAN keeps every neighborhood in memory, of a heap all pairs.
    _, cell = np.unique(np.floor((points - points.min(0)) / (gap * _CELL)), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    sums = np.bincount(cell, share)
    centers = np.stack([np.bincount(cell, share * axis) / sums for axis in points.T], axis=1)
    whole = DBSCAN(eps=gap, min_samples=1).fit_predict(centers, sample_weight=sums / (sums.sum() * DENSE))
    found = whole[cell]
    if (found < 0).all():  # no place is dense: take the heaviest Gaussian
        found = np.where(np.arange(len(found)) == share.argmax(), 0, -1)
    totals = np.bincount(found[found >= 0], weights=share[found >= 0]) / share.sum()
    boxes = []
    for i, total in enumerate(totals.tolist()):
        ends = np.quantile(points[found == i], (OUTLIERS, 1 - OUTLIERS), axis=0, method="nearest")
        low, high = map(tuple, ends.tolist())
        boxes.append(Box(low, high, total))
    return boxes


def rank_views(
    views: Mapping[str, VisibleGaussians],
    means: Float[Tensor, "n 3"],
    scores: Float[Tensor, " n"],
    threshold: float,
) -> list[Viewpoint]:
    """Rank every view by the pixels that Gaussians fill in it (hidden ones fill none). Views that show the
    match come first, best first.

    The peak matters most: only Gaussians half-way or more from the threshold to the highest peak of all views
    count as the match, so that four lukewarm windows don't outrank the one rose window. If no peak reaches
    the threshold, the scene's median relevancy takes its place, and the views that come closest lead.
    """
    if not views:
        return []
    # Numbers stay on the device until the end, since reading each would wait for a GPU.
    peaks = torch.stack([_peak(view, scores) for view in views.values()])
    top = peaks.amax()
    low = torch.where(top > threshold, threshold, scores.median())
    level = low + STRONG * (top - low)
    closeness = ((peaks - low) / (top - low).clamp_min(1e-9)).clamp(0, 1)
    rows = []
    for view in views.values():
        values, shares = scores[view.rows], view.shares
        strong = (values > level) * shares
        size = (strong.sum() / LARGE).clamp_max(1.0).sqrt()
        excess = (values - low) * strong
        centered = (excess * _centeredness(view, means)).sum() / excess.sum().clamp_min(1e-12)
        rows.append(torch.stack([((values > threshold) * shares).sum(), size * centered]))
    areas, fitness = torch.stack(rows).unbind(1)
    figures = torch.stack([areas, peaks, closeness * fitness], dim=1).tolist()
    ranks = [
        Viewpoint(name, view.camera, area, peak, rank, shown=area * view.size >= 1)
        for (name, view), (area, peak, rank) in zip(views.items(), figures, strict=True)
    ]
    return sorted(ranks, key=lambda view: (view.shown, view.rank), reverse=True)


def _peak(view: VisibleGaussians, scores: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """Compute the mean relevancy of the most relevant share `PEAK` of a view."""
    order = scores[view.rows].argsort(descending=True)
    shares = view.shares[order]
    before = shares.cumsum(0) - shares
    counted = (PEAK - before).clamp_min(0).minimum(shares)
    return (scores[view.rows][order] * counted).sum() / PEAK


def _centeredness(view: VisibleGaussians, means: Float[Tensor, "n 3"]) -> Float[Tensor, " m"]:
    """Compute weights of 1 for Gaussians in the middle half of a view, falling to `RIM` at its rim."""
    x, y, _ = projected(view.camera, means[view.rows]).unbind(1)
    off = torch.maximum((2 * x / view.camera.width - 1).abs(), (2 * y / view.camera.height - 1).abs())
    return 1 - (1 - RIM) * ((off - 0.5) / 0.5).nan_to_num(1.0).clamp(0, 1)
