"""Learning codes of finished Gaussians from the photos' targets: gather, sharpen, compress.

A crop yields a single feature for everything in it, so features gathered from crops are blurred at the crop's
scale; dense features are several times as fine. So Gaussians with similar dense features form a group, and
each moves part of the way to the mean of its group, where the blur of many places cancels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.common.console import progress, say, tracked
from lang3dxl_ns.common.device import in_full_precision
from lang3dxl_ns.components.feature_decoder import Decoder, Gathered
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.preparation.targets import Batch, foreground
from lang3dxl_ns.rendering import composite
from lang3dxl_ns.rendering.gathering import Composite, Pixels, gather
from lang3dxl_ns.scene.camera import resized
from lang3dxl_ns.training.state import PhotoCamera, Training

ClipMaps = Callable[[], Iterable[Float[Tensor, "hd wd c"]]]
DenseMaps = Callable[[], Iterable[Float[Tensor, "t t d"]]]
DENSE_AXES = 32
"""Number of principal components of the dense features by which groups are formed."""
LONGER_SIDE = 1_600
"""Longer side in pixels to which larger photos are reduced for gathering: a CLIP crop covers hundreds of
pixels, and time and memory grow with their number."""
_GROUPS = 128
_SHARE = 0.5
"""Fraction of the way that a feature moves to its group's mean; the rest keeps individual differences."""
_SAMPLE = 20_000
"""Largest number of Gaussians from which groups are formed."""
_ROWS = 65_536
"""Number of Gaussians processed at a time, to bound memory."""


@dataclass(frozen=True, eq=False)
class TargetView:
    """Camera and targets of a photo."""

    composite: Composite
    """Function that composites values of the Gaussians as this camera sees them."""
    size: tuple[int, int]
    """Rows and columns of the composited map."""
    clip: Float[Tensor, "hd wd c"]
    """CLIP features at any resolution."""
    dense: Float[Tensor, "t t d"] | None = None
    """Dense features of the photo squashed to a square."""
    mask: Bool[Tensor, "h w"] | None = None
    """Foreground; None if it is the whole photo."""


def learn_words(run: Training, photos: Iterable[tuple[PhotoCamera, Batch]], count: int) -> None:
    """Give a run's Gaussians codes that represent the targets of this number of photos; see `learn_codes`."""
    semantics, facts = run.parts.semantics, run.facts
    assert semantics is not None and facts.clip_targets is not None
    views, means = (_target_view(run, *photo) for photo in photos), run.gaussians["means"].detach()
    # Initial codes are fitted to the unsharpened targets, which the loss compares with.
    dense = None if run.learns_from_renderings else facts.dense_targets
    codes = learn_codes(semantics.decoder, views, count, means, facts.clip_targets, dense)
    if run.learns_from_renderings:
        run.gaussians["codes"].data.copy_(codes.nan_to_num(0.0))
    else:
        run.gaussians["codes"] = Parameter(codes.to(run.device), requires_grad=False)


def forget_words(run: Training) -> None:
    """Remove codes that were gathered for a question in training, since the Gaussians still change."""
    if run.learns_words_at_the_end and "codes" in run.gaussians:
        del run.gaussians["codes"]


def _target_view(run: Training, view: PhotoCamera, batch: Batch) -> TargetView:
    camera = resized(view.camera(run.pose(view)).detach(), LONGER_SIDE)
    splats, size = run.splats(), (camera.height, camera.width)
    return TargetView(
        partial(composite, splats, camera, backend=run.backend),
        size,
        batch["clip_target"],
        batch.get("dense_target"),
        foreground(batch),
    )


# A training step's autocast would keep 16-bit copies of the first weights through all steps of the fit.
@in_full_precision
def learn_codes(
    decoder: Decoder,
    views: Iterable[TargetView],
    count: int,
    means: Float[Tensor, "n 3"],
    clip_targets: ClipMaps,
    dense_targets: DenseMaps | None = None,
) -> Float[Tensor, "n code"]:
    """Average the photos' targets over the Gaussians that they show, and let the decoder learn codes, with
    progress bars and a line about what it learned.

    Codes of Gaussians that no photo shows are NaN.

    Args:
        decoder: a decoder with `learn_gaussians`, which is trained in place.
        views: the photos, each once.
        count: number of the photos.
        means: centers of the Gaussians, which determine number, type and device of the codes.
        clip_targets: the CLIP targets of the views, from which a basis is computed.
        dense_targets: the dense features of the views; None if features are not to be sharpened.
    """
    basis = fine_basis = None
    width = channels = decoder.clip_dim
    if decoder.gathered_channels is not None and decoder.gathered_channels < width:
        width = channels = decoder.gathered_channels
        basis = PrincipalBasis.of(clip_targets(), width)
    if dense_targets is not None:
        fine_basis = PrincipalBasis.of(map(_unit, dense_targets()), DENSE_AXES)
        channels += fine_basis.axes.shape[1]

    def targets():
        for view in tracked(views, "gathering features", count):
            maps = [view.clip if basis is None else basis.to(view.clip).coordinates(view.clip)]
            if fine_basis is not None and view.dense is not None:
                maps.append(fine_basis.to(view.clip).coordinates(_unit(view.dense)))
            yield view.composite, Pixels.of(maps, view.size, view.mask)

    features, mass = gather(len(means), targets(), channels, means)
    if fine_basis is not None:
        features = sharpen(features[:, :width], features[:, width:], mass)
    with progress("learning codes", decoder.learning_steps(len(means))) as advance:
        codes = decoder.learn_gaussians(Gathered(features, mass, basis), advance)
    if decoder.learned is not None:
        say(decoder.learned)
    # Many features are kept on the CPU, so codes that are features themselves come from there.
    return codes.to(means.device)


def _unit(dense: Float[Tensor, "t t d"]) -> Float[Tensor, "t t d"]:
    return F.normalize(dense.float(), dim=-1)


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
