"""Sharpening of features that Gaussians gathered from crops, by dense features.

A crop yields a single feature for everything in it, so features gathered from crops are blurred at the crop's
scale; dense features are several times as fine. So Gaussians with similar dense features form a group, and
each moves part of the way to the mean of its group, where the blur of many places cancels.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

_GROUPS = 128
_SHARE = 0.5
"""Fraction of the way that a feature moves to its group's mean; the rest keeps individual differences."""
_SAMPLE = 20_000
"""Largest number of Gaussians from which groups are formed."""
_ROWS = 65_536
"""Number of Gaussians processed at a time, to bound memory."""


def sharpen(
    features: Float[Tensor, "n c"], dense: Float[Tensor, "n r"], mass: Float[Tensor, " n"]
) -> Float[Tensor, "n c"]:
    """Move features half the way to the mean of their group, which keeps the sum of mass · feature. `dense`
    are gathered dense features, or their coordinates in an orthonormal basis; `mass` the pixels that each
    Gaussian fills, weighted. One without mass keeps its features, affecting none."""
    seen = mass > 0
    if not seen.any():
        return features
    share = mass / mass.max()  # sums of masses of any size stay finite
    group = torch.zeros_like(seen, dtype=torch.long)
    group[seen] = _groups(dense[seen], share[seen])
    total = share.new_zeros(_GROUPS).index_add_(0, group, share)
    weight = (share / total[group].clamp_min(torch.finfo(share.dtype).tiny))[:, None]
    means = features.new_zeros(_GROUPS, features.shape[1])
    parts = seen.nonzero()[:, 0].split(_ROWS)
    for rows in parts:
        means.index_add_(0, group[rows], weight[rows] * features[rows])
    sharp = features.clone()
    for rows in parts:
        sharp[rows] = sharp[rows].lerp(means[group[rows]], _SHARE)
    return sharp


def _groups(dense: Float[Tensor, "n r"], mass: Float[Tensor, " n"]) -> Int[Tensor, " n"]:
    """Find each Gaussian's nearest k-means centroid; weights are √mass, so small things have groups too."""
    from sklearn.cluster import KMeans

    dense = dense - dense.mean(0)  # distances far from 0 would cancel in float32
    chosen = torch.arange(len(dense))
    if len(dense) > _SAMPLE:
        chosen = torch.linspace(0, len(dense) - 1, _SAMPLE, dtype=torch.float64).long()
    sample, weight = (values[chosen.to(values.device)].cpu().numpy() for values in (dense, mass.sqrt()))
    found = KMeans(min(_GROUPS, len(sample)), n_init=1, random_state=0).fit(sample, sample_weight=weight)
    centers = torch.from_numpy(found.cluster_centers_).to(dense)
    return torch.cat([torch.cdist(rows, centers).argmin(1) for rows in dense.split(_ROWS)])
