"""Ranking of views by how well they show a match, without rendering them."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.query.match import Viewpoint
from lang3dxl_ns.query.places import STRONG
from lang3dxl_ns.query.visibility import VisibleGaussians

PEAK = 1e-3
"""Share of a view over which its peak is averaged, so that one stray Gaussian does not decide."""
LARGE = 0.2
"""Share of a view above which larger matches score no higher."""
RIM = 0.25
"""Weight of a match at a view's rim, where it is likely cut off; it is 1 in the middle half."""


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
    camera = view.camera
    pose = to_device(camera.view_matrix.to(means.dtype), means.device)
    points = means[view.rows] @ pose[:3, :3].T + pose[:3, 3]
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    x, y = (points[:, axis] / points[:, 2] for axis in (0, 1))
    off = torch.maximum(
        (2 * (x * fx + cx) / camera.width - 1).abs(), (2 * (y * fy + cy) / camera.height - 1).abs()
    )
    return 1 - (1 - RIM) * ((off - 0.5) / 0.5).nan_to_num(1.0).clamp(0, 1)
