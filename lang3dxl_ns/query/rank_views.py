"""Ranking of views by how well they show a match, without rendering them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.query.places import STRONG
from lang3dxl_ns.query.visibility import VisibleGaussians

PEAK = 1e-3
"""Share of a view that its peak is the mean of: a small thing, not one stray Gaussian."""
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
    """Mean relevancy of the most relevant thousandth of the view, 0…1."""
    rank: float
    """0…1: closeness of the peak to the scene's highest, times size, times centeredness."""


def rank_views(
    views: Mapping[str, VisibleGaussians],
    means: Float[Tensor, "n 3"],
    scores: Float[Tensor, " n"],
    threshold: float,
) -> dict[str, ViewRank]:
    """The rank of every view, from the pixels that Gaussians fill in it (hidden ones fill none).

    The peak comes first: only Gaussians half-way or more from the threshold to the highest peak of all views
    count as the match, so that four lukewarm windows don't outrank the one rose window. Where no peak
    reaches the threshold, the scene's median relevancy takes its place: the views that come closest lead.
    """
    peaks = {name: _peak(view, scores) for name, view in views.items()}
    areas = {name: view.share((scores > threshold).float()) for name, view in views.items()}
    top = max(peaks.values(), default=0.0)
    low = threshold if top > threshold else float(scores.median())
    level = low + STRONG * (top - low)
    ranks = {}
    for name, view in views.items():
        rows, shares = view.rows.long(), view.pixels.float() / view.size
        strong = scores[rows] > level
        size = min(float(shares[strong].sum()) / LARGE, 1.0) ** 0.5
        closeness = min(max(peaks[name] - low, 0.0) / max(top - low, 1e-9), 1.0)
        excess = (scores[rows] - low) * shares * strong
        centered = float((excess * _centeredness(view, means)).sum() / excess.sum().clamp_min(1e-12))
        ranks[name] = ViewRank(areas[name], peaks[name], closeness * size * centered)
    return ranks


def _peak(view: VisibleGaussians, scores: Float[Tensor, " n"]) -> float:
    """Mean relevancy of the most relevant share `PEAK` of a view."""
    order = scores[view.rows].argsort(descending=True)
    shares = view.pixels.float()[order] / view.size
    before = shares.cumsum(0) - shares
    counted = (PEAK - before).clamp_min(0).minimum(shares)
    return float((scores[view.rows][order] * counted).sum()) / PEAK


def _centeredness(view: VisibleGaussians, means: Float[Tensor, "n 3"]) -> Float[Tensor, " m"]:
    """1 for Gaussians in the middle half of a view, falling to `RIM` at its rim."""
    camera = view.camera
    pose, k = camera.view_matrix.to(means), camera.intrinsics.to(means)
    points = means[view.rows] @ pose[:3, :3].T + pose[:3, 3]
    pixels = points[:, :2] / points[:, 2:] * k[[0, 1], [0, 1]] + k[:2, 2]
    off = (2 * pixels / pixels.new_tensor([camera.width, camera.height]) - 1).abs().amax(1)
    return 1 - (1 - RIM) * ((off - 0.5) / 0.5).nan_to_num(1.0).clamp(0, 1)
