"""Learning codes of finished Gaussians from the photos' targets: gather, sharpen, compress."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.common.console import progress, say, tracked
from lang3dxl_ns.common.device import in_full_precision
from lang3dxl_ns.components.feature_decoder import Gathered, LearningDecoder
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.preparation.targets import Batch, foreground
from lang3dxl_ns.rendering import Splats, composite
from lang3dxl_ns.rendering.gathering import Composite, Pixels, gather
from lang3dxl_ns.scene.camera import Camera, resized
from lang3dxl_ns.training.batches import TrainingData
from lang3dxl_ns.training.sharpening import sharpen
from lang3dxl_ns.training.state import Training

DENSE_AXES = 32
"""Number of principal components of the dense features by which groups are formed."""
LONGER_SIDE = 1_600
"""Longer side in pixels to which larger photos are reduced for gathering: a CLIP crop covers hundreds of
pixels, and time and memory grow with their number."""


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


def begin_codes(run: Training, data: TrainingData) -> None:
    """Let codes begin where the warm-up ends, from the photos' features if the settings say so: once per run,
    also if it is resumed or prolonged."""
    if run.learns_from_renderings and run.warm_up_is_over and not run.codes_have_begun:
        if run.settings.codes_from == "photos":
            learn_words(run, data)
        run.codes_have_begun = True


def learn_words(run: Training, data: TrainingData) -> None:
    """Give a run's Gaussians codes that represent the targets of its photos; see `learn_codes`."""
    semantics, facts = run.parts.semantics, run.facts
    assert semantics is not None and facts.clip_targets is not None
    assert isinstance(semantics.decoder, LearningDecoder)
    splats = run.splats()
    views = (
        target_view(splats, view.camera(run.pose(view)).detach(), LONGER_SIDE, batch)
        for view, batch in data.every_photo()
    )
    means = run.gaussians["means"].detach()
    # Initial codes are fitted to the unsharpened targets, which the loss compares with.
    dense = None if run.learns_from_renderings else facts.dense_targets
    codes = learn_codes(semantics.decoder, views, len(data.cameras), means, facts.clip_targets, dense)
    if run.learns_from_renderings:
        run.gaussians["codes"].data.copy_(codes.nan_to_num(0.0))
    else:
        run.gaussians["codes"] = Parameter(codes.to(run.device), requires_grad=False)


def forget_words(run: Training) -> None:
    """Remove codes that were gathered for a question in training, since the Gaussians still change."""
    if run.learns_words_at_the_end and "codes" in run.gaussians:
        del run.gaussians["codes"]


def target_view(splats: Splats, camera: Camera, longer_side: int, batch: Batch) -> TargetView:
    """Return a photo's targets as a view of the splats, from its camera at most this large, pixels."""
    camera = resized(camera, longer_side)
    seen, size = partial(composite, splats, camera), (camera.height, camera.width)
    return TargetView(seen, size, batch["clip_target"], batch.get("dense_target"), foreground(batch))


# A training step's autocast would keep 16-bit copies of the first weights through all steps of the fit.
@in_full_precision
def learn_codes(
    decoder: LearningDecoder,
    views: Iterable[TargetView],
    count: int,
    means: Float[Tensor, "n 3"],
    clip_targets: Callable[[], Iterable[Float[Tensor, "hd wd c"]]],
    dense_targets: Callable[[], Iterable[Float[Tensor, "t t d"]]] | None = None,
) -> Float[Tensor, "n code"]:
    """Average the photos' targets over the Gaussians that they show, and let the decoder learn codes, with
    progress bars and a line about what it learned.

    Codes of Gaussians that no photo shows are NaN.

    Args:
        decoder: the decoder, which is trained in place.
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
