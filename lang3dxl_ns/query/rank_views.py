"""Ranking of views by how well they show a match, without rendering them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.query.places import STRONG
from lang3dxl_ns.query.visibility import VisibleGaussians

GRID = 32
"""Cells along a view's longer side: a peak is a whole cell that matches, not one stray Gaussian."""
LARGE = 0.2
"""Share of a view beyond which a larger match shows no better."""
RIM = 0.25
"""Weight of a match at a view's rim, where it is likely cut off; 1 in the middle half."""


@dataclass(frozen=True)
class ViewRank:
    """How well one view shows a match."""

    area: float
    """Share of the view that matches."""
    peak: float
    """Relevancy of the best cell, 0…1."""
    rank: float
    """0…1: closeness of the peak to the scene's highest, times size, times centeredness."""


def rank_views(
    views: Mapping[str, VisibleGaussians],
    means: Float[Tensor, "n 3"],
    scores: Float[Tensor, " n"],
    threshold: float,
) -> dict[str, ViewRank]:
    """The rank of every view.

    Each view's heat map is approximated on a coarse grid, putting all pixels that a Gaussian fills (so
    hidden ones count for nothing) at its center. The peak comes first: cells count as the match only if
    their relevancy is above half-way from the threshold to the highest peak of all views, so that four
    lukewarm windows don't outrank the one rose window.
    """
    maps = {name: _cells(view, means, scores) for name, view in views.items()}
    top = max((float(cells.max()) for cells in maps.values()), default=0.0)
    if top <= threshold:  # nothing matches as a whole: rank the views by what comes closest
        threshold = float(torch.cat([cells.flatten() for cells in maps.values()]).median())
    matching = (scores > threshold).float()
    return {name: _rank(views[name], maps[name], matching, threshold, top) for name in views}


def _rank(view: VisibleGaussians, cells: Tensor, matching: Tensor, threshold: float, top: float) -> ViewRank:
    area, peak = view.share(matching), float(cells.max())
    if peak <= threshold:  # no cell matches as a whole: it is small, or far off
        return ViewRank(area, peak, 1e-3 * peak * area)
    strong = cells > threshold + STRONG * (top - threshold)
    excess = (cells - threshold).clamp_min(0) * strong
    weight = float(excess.sum())
    closeness = (peak - threshold) / (top - threshold)
    if weight == 0:
        return ViewRank(area, peak, 1e-2 * closeness * min(area / LARGE, 1.0) ** 0.5)
    size = min(float(strong.float().mean()) / LARGE, 1.0) ** 0.5
    centered = float((excess * _centeredness(cells)).sum()) / weight
    return ViewRank(area, peak, closeness * size * centered)


def _cells(
    view: VisibleGaussians, means: Float[Tensor, "n 3"], scores: Float[Tensor, " n"]
) -> Float[Tensor, "r c"]:
    """Mean relevancy of every cell, composited over black, 0…1."""
    camera, rows = view.camera, view.rows.long()
    side = max(camera.width, camera.height) / GRID
    columns, lines = max(round(camera.width / side), 1), max(round(camera.height / side), 1)
    pose, k = camera.view_matrix.to(means), camera.intrinsics.to(means)
    points = means[rows] @ pose[:3, :3].T + pose[:3, 3]
    place = points[:, :2] / points[:, 2:] * k[[0, 1], [0, 1]] + k[:2, 2]
    x = (place[:, 0] / camera.width * columns).long().clamp(0, columns - 1)
    y = (place[:, 1] / camera.height * lines).long().clamp(0, lines - 1)
    filled = torch.bincount(
        y * columns + x, weights=scores[rows] * view.pixels.float(), minlength=lines * columns
    )
    area = camera.width * camera.height / (lines * columns)
    return (filled / area).clamp_max(1.0).view(lines, columns)


def _centeredness(cells: Float[Tensor, "r c"]) -> Float[Tensor, "r c"]:
    """1 in the middle half of a view, falling to `RIM` at its rim."""
    rows, columns = (((torch.arange(n, device=cells.device) + 0.5) / n * 2 - 1).abs() for n in cells.shape)
    off = torch.maximum(rows[:, None], columns)
    return 1 - (1 - RIM) * ((off - 0.5) / 0.5).clamp(0, 1)
