"""Sharpening of gathered CLIP features by dense ones: what looks alike may be called alike.

A crop says one thing about all that it shows, so what is gathered from crops is blurred by their side; dense
features are several times as fine. Gaussians with similar dense features form a group, and each moves part of
the way to the mean of its group, where the blur of a thousand places cancels.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

DENSE_AXES = 32
"""Principal components of the dense features that tell groups apart."""
_GROUPS = 64
_SHARE = 0.5
"""Part of the way to the group's mean: the rest keeps what a group of different things does not share."""
_SAMPLE = 20_000
"""Gaussians that the groups are found from."""
_ROWS = 65_536
"""Gaussians at a time, to bound memory."""


def sharpen(
    features: Float[Tensor, "n c"], dense: Float[Tensor, "n r"], mass: Float[Tensor, " n"]
) -> Float[Tensor, "n c"]:
    """Features moved half the way to the mean of their group; the sum of mass · feature stays the same.

    Args:
        features: gathered CLIP features of each Gaussian.
        dense: gathered dense features, or coordinates of them; Euclidean distance tells groups apart.
        mass: pixels that each Gaussian fills, weighted; one without keeps its features, and affects none.
    """
    seen = mass > 0
    if not seen.any():
        return features
    group = torch.zeros(len(mass), dtype=torch.long, device=mass.device)
    group[seen] = _groups(dense[seen], mass[seen])
    weight = torch.zeros(_GROUPS, dtype=torch.float64, device=mass.device).index_add_(0, group, mass.double())
    share = (mass / weight.to(mass).clamp_min(torch.finfo(mass.dtype).tiny)[group])[:, None]
    means = features.new_zeros(_GROUPS, features.shape[1])
    for rows in torch.arange(len(features), device=mass.device).split(_ROWS):
        means.index_add_(0, group[rows], share[rows] * features[rows])
    parts = [
        torch.where(seen[rows, None], features[rows].lerp(means[group[rows]], _SHARE), features[rows])
        for rows in torch.arange(len(features), device=mass.device).split(_ROWS)
    ]
    return torch.cat(parts)


def _groups(dense: Float[Tensor, "n r"], mass: Float[Tensor, " n"]) -> Int[Tensor, " n"]:
    """The nearest of k-means centroids; Gaussians count by √mass, so that small things have groups too."""
    from sklearn.cluster import KMeans

    weight = (mass / mass.max()).sqrt().cpu()
    chosen = torch.arange(len(dense))
    if len(dense) > _SAMPLE:
        chosen = torch.linspace(0, len(dense) - 1, _SAMPLE, dtype=torch.float64).long()
    sample = dense[chosen.to(dense.device)].cpu().numpy()
    found = KMeans(min(_GROUPS, len(sample)), n_init=1, random_state=0)
    centers = torch.from_numpy(found.fit(sample, sample_weight=weight[chosen].numpy()).cluster_centers_)
    return torch.cat([torch.cdist(rows, centers.to(rows)).argmin(1) for rows in dense.split(_ROWS)])
