"""Evaluation of runs by more than their answers: agreement of features with targets, limit and chance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from lang3dxl_ns.common.image import fitted_size, resize, resize_nearest
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler, DownsamplerConfig
from lang3dxl_ns.evaluation.layouts import Truth
from lang3dxl_ns.evaluation.photo_metrics import EvaluatedPhoto, psnr
from lang3dxl_ns.evaluation.score_scene import Masks, lifted_labels, truths_of
from lang3dxl_ns.evaluation.scores import LanguageScorer, Maps, average_precision, inside, map_size
from lang3dxl_ns.plugin.cameras import to_rasterizer
from lang3dxl_ns.plugin.evaluation import Evaluation
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.plugin.photo_dataset import EvalPhotos
from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline
from lang3dxl_ns.preparation.targets import Batch
from lang3dxl_ns.rendering import Splats, composite
from lang3dxl_ns.rendering.rasterize import Backend
from lang3dxl_ns.scene.camera import Camera
from lang3dxl_ns.scene.photo import Photo

LabelLimit = Callable[[Camera], Float[Tensor, "categories h w"]]


def judge(pipeline: Lang3DXLPipeline) -> None:
    """Make a run's evaluation, of which it may have one already, a `JudgedEvaluation`."""
    pipeline.evaluation = JudgedEvaluation(pipeline.model, pipeline.datamanager, pipeline.config)


class JudgedEvaluation(Evaluation):
    """Evaluation that adds the figures of `model_features` and `bounds`."""

    def evaluate_photos(
        self, photos: EvalPhotos, scorer: LanguageScorer | None, fits_looks: bool = False
    ) -> Iterator[EvaluatedPhoto]:
        """Render and score photos, after lifting their labels to the Gaussians."""
        self._limit = None if scorer is None else self._label_limit(scorer, photos)
        yield from super().evaluate_photos(photos, scorer, fits_looks)

    def _label_limit(self, scorer: LanguageScorer, photos: EvalPhotos) -> LabelLimit:
        """Build a function that renders the labels themselves, lifted from the photos to the Gaussians."""
        truth = scorer.truth

        def labeled() -> Iterator[tuple[Camera, Masks]]:
            for index in photos.indices:
                photo, camera = photos.dataset.photos[index], photos.dataset.cameras[index : index + 1]
                truths = truths_of(truth, photo, truth.scoring_size(photo.height, photo.width))
                yield to_rasterizer(camera), {name: found.mask for name, found in truths.items()}

        return label_limit(self._model.splats(), labeled(), truth.categories, self._model.backend)

    def _evaluate_photo(
        self, camera: Cameras, batch: Batch, photo: Photo, scorer: LanguageScorer | None
    ) -> EvaluatedPhoto:
        evaluated = super()._evaluate_photo(camera, batch, photo, scorer)
        evaluated.metrics |= model_features(self._model, camera, batch)
        if scorer is not None and self._limit is not None:
            size = map_size(evaluated.maps)
            keep = batch["mask"][..., 0] if "mask" in batch else None
            lifted = scorer.named(self._limit(to_rasterizer(camera)), size)
            evaluated.metrics |= bounds(inside(lifted, keep), truths_of(scorer.truth, photo, size))
        return evaluated


# ── words: limit and chance ─────────────────────────────────────────────────────────────────────────────


def label_limit(
    splats: Splats, views: Iterable[tuple[Camera, Masks]], categories: list[str], backend: Backend = "auto"
) -> LabelLimit:
    """Return a function from a view to its maps, in the order of the categories: exact labels, lifted to the
    Gaussians and rendered back. They are the upper limit of word scores on a trained geometry."""
    shares = lifted_labels(splats, views, categories, backend)
    return lambda camera: composite(splats, camera, shares, backend).permute(2, 0, 1)


def bounds(labels: Maps, truths: Mapping[str, Truth]) -> dict[str, float]:
    """Compute average precision by chance and at best, for every category in the photo.
    `chance_ap_{category}` is that of a map without information, the share of positives. `limit_ap_{category}`
    is that of `labels`, the exact labels after lifting and rendering (`label_limit`)."""
    found: dict[str, float] = {}
    for category, truth in truths.items():
        best = average_precision(labels[category].cpu().numpy(), truth.mask)
        if best is not None:
            found[f"chance_ap_{category}"] = float(truth.mask.mean())
            found[f"limit_ap_{category}"] = best
    return found


# ── features ────────────────────────────────────────────────────────────────────────────────────────────


@torch.no_grad()
def model_features(model: Lang3DXLModel, camera: Cameras, batch: Batch) -> dict[str, float]:
    """Measure agreement with a photo's targets, for the model and for the mean training feature."""
    if model.carried is None or "clip_target" not in batch:
        return {}
    assert model.config.decode_size is not None
    clip, dense = _feature_maps(model, camera, model.config.decode_size[1])
    size = clip.shape[0], clip.shape[1]
    mask = resize_nearest(batch["mask"][..., 0], size) if "mask" in batch else None
    target = batch["clip_target"]
    predicted, weight = match(clip, target, batch["crop_sides"], mask)
    metrics = feature_metrics("clip", predicted, target, model.clip_mean, weight)
    if dense is not None and "dense_target" in batch:
        target = resize(batch["dense_target"], size)
        metrics |= feature_metrics("dense", dense, target, model.dense_mean, mask)
    return metrics


def _feature_maps(
    model: Lang3DXLModel, camera: Cameras, longer_side: int
) -> tuple[Float[Tensor, "h w clip"], Float[Tensor, "h w dense"] | None]:
    """Compute features in a camera, decoded before or after compositing, depending on the decoder."""
    decoder, carried = model.semantic_field, model.carried
    assert decoder is not None and carried is not None
    if not decoder.per_gaussian:
        codes = model.composite(camera, carried)
        return decoder(resize_nearest(codes, fitted_size(codes, longer_side)))
    # The last layer is linear, so hidden activations are composited and divided by coverage.
    known = carried.isfinite().all(1, keepdim=True)
    hidden = torch.where(known, decoder.hidden(torch.where(known, carried, 0.0)), 0.0)
    maps = model.composite(camera, torch.cat([hidden, known.to(hidden)], dim=1))
    maps = resize_nearest(maps, fitted_size(maps, longer_side))
    clip, head = maps[..., :-1] / maps[..., -1:].clamp_min(1e-3), decoder.clip_head()
    return clip if head is None else F.linear(clip, *head), None


def match(
    features: Float[Tensor, "h w c"],
    target: Float[Tensor, "hd wd c"],
    crop_sides: Sequence[float],
    mask: Float[Tensor, "h w"] | None = None,
) -> tuple[Float[Tensor, "hd wd c"], Float[Tensor, "hd wd"]]:
    """Average features over the target's crops, and compute the weight of each cell. The kernel is the
    downsampler's without its learned attenuation, so it is the same for every way of training."""
    kernel = AttenuatedDownsampler(DownsamplerConfig(hidden=0), features.shape[-1])
    return kernel(features, (target.shape[0], target.shape[1]), crop_sides, mask)


def feature_metrics(
    kind: str,
    predicted: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    mean: Float[Tensor, " c"],
    weight: Float[Tensor, "h w"] | None = None,
) -> dict[str, float]:
    """Compute L1, PSNR (peak 1) and cosine of `predicted`, and the same for predicting the `mean` everywhere.

    Features are compared on the encoder's own scale, as in Lang3D-XL's encoder ablation. Cells of zero weight
    (no foreground) are ignored. Keys are `{kind}_l1`, `{kind}_psnr` and `{kind}_cosine`, and the same with
    `_of_mean` appended.
    """
    cells = target.new_ones(target.shape[:2], dtype=torch.bool) if weight is None else weight > 0
    if not cells.any():
        return {}
    figures, wanted = {}, target[cells].double()
    for whose, features in (("", predicted), ("_of_mean", mean.expand_as(target))):
        found = features[cells].double()
        figures[f"{kind}_l1{whose}"] = float(F.l1_loss(found, wanted))
        figures[f"{kind}_psnr{whose}"] = float(psnr(found, wanted))
        figures[f"{kind}_cosine{whose}"] = float(F.cosine_similarity(found, wanted, dim=-1).mean())
    return figures
