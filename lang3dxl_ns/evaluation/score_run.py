"""Scores of a run, finished or in training: its photos' colors, features and words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.console import say, tracked
from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.image import fitted_size, resize_nearest
from lang3dxl_ns.common.reports import host_peak, synchronize
from lang3dxl_ns.components.losses import resize
from lang3dxl_ns.evaluation.aggregate import average
from lang3dxl_ns.evaluation.ground_truth import GroundTruth, Layout, find_ground_truth
from lang3dxl_ns.evaluation.half_image import PROTOCOL, HalfImageProtocol
from lang3dxl_ns.evaluation.label_limit import label_limit
from lang3dxl_ns.evaluation.photo_metrics import (
    EvaluatedPhoto,
    ImageMetrics,
    corrected_psnr,
    feature_metrics,
    match,
)
from lang3dxl_ns.evaluation.score_scene import truths_of
from lang3dxl_ns.evaluation.scores import LanguageScorer, bounds, inside, map_size, open_scorer
from lang3dxl_ns.preparation.targets import Batch, foreground
from lang3dxl_ns.query.answer import relevancy_maps
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import NOT_FINISHED
from lang3dxl_ns.rendering import composite
from lang3dxl_ns.scene.camera import Camera
from lang3dxl_ns.training.batches import TrainingData
from lang3dxl_ns.training.parts import Semantics
from lang3dxl_ns.training.snapshot import snapshot
from lang3dxl_ns.training.state import PhotoCamera, Training

Split = Literal["held-out", "seen"]


@dataclass
class EvaluationSettings:
    """Settings of an evaluation."""

    ground_truth: Path | None = None
    """Folder of ground truth, in any layout of docs/evaluation.md; `ns-eval` then reports how well words find
    their pixels. Default: ground_truth/ or label/ in the data folder, or label/<scene> beside it, if
    present."""
    ground_truth_layout: Layout | Literal["auto"] = "auto"
    """Layout of ground truth: HolyScenes' masks, LERF-OVS' or PT-OVS' labels, or plain; `auto` detects it."""
    evaluated_photos: Split = "held-out"
    """Photos that `ns-eval` evaluates. `held-out`: photos held out of training. `seen`: training photos with
    ground truth, as in HolyScenes' main tables."""


@dataclass(eq=False)
class Evaluation:
    """Scores of a run, against the ground truth of the settings."""

    run: Training
    data: TrainingData
    settings: EvaluationSettings

    @cached_property
    def scorer(self) -> LanguageScorer | None:
        """Scorer of words in photos; None if the scene has no ground truth or the run has no semantics."""
        folder = self.settings.ground_truth or find_ground_truth(self.data.capture.folder)
        if folder is None or self.run.parts.semantics is None:
            return None
        truth = GroundTruth(folder, self.settings.ground_truth_layout)
        truth.check(list(self.data.views))
        return open_scorer(truth, self.data.config.clip, self.run.device)

    def evaluate(self, split: Split | None = None) -> Iterator[EvaluatedPhoto]:
        """Render and score the photos of a split (default: the configured one), with a progress bar."""
        split = split or self.settings.evaluated_photos
        names = self.data.capture.split.held_out if split == "held-out" else self._seen()
        return score_photos(self.run, self.data, names, self.scorer, self._fits_looks(split))

    def _seen(self) -> list[str]:
        """List the training photos with a label."""
        if self.scorer is None:
            raise UserError("seen photos can be evaluated only with ground truth and CLIP")
        truth = self.scorer.truth
        labeled = [name for name in self.data.capture.split.train if truth.key(name) is not None]
        if not labeled:
            raise UserError(f"none of the training photos has a label in {truth.folder}")
        return labeled

    def _fits_looks(self, split: Split) -> bool:
        """Return whether the half-image protocol applies: to held-out photos, whose looks are unknown."""
        return self.run.parts.appearance is not None and split == "held-out"

    def scored(self, output_path: Path | None = None, get_std: bool = False) -> dict[str, Any]:
        """Compute means and totals over the evaluated photos, and `peak_memory_mb` of the process (or of the
        GPU, if one is used); see `evaluation.aggregate.average`. output_path: folder for a picture of every
        photo, optional. get_std: add standard deviations, `protocol` (what was scored, and how), and `photos`
        (the figures of each)."""
        evaluated = []
        for photo in self.evaluate():
            if output_path is not None:
                photo.write_pictures(output_path)
            photo.images, photo.maps = {}, {}  # pictures and maps of all photos would take too much memory
            evaluated.append(photo)
        results = average([photo.metrics for photo in evaluated], get_std)
        on_gpu = self.run.device.type == "cuda"
        results["peak_memory_mb"] = (torch.cuda.max_memory_allocated() if on_gpu else host_peak()) / 2**20
        if get_std:
            results["protocol"] = self._protocol(evaluated)
            results["photos"] = {photo.name: photo.metrics for photo in evaluated}
        return results

    def _protocol(self, evaluated: list[EvaluatedPhoto]) -> dict[str, Any]:
        scorer = self.scorer
        masked = sum(self.data.photos[photo.name].mask_path is not None for photo in evaluated)
        split, trained = self.settings.evaluated_photos, set(self.data.capture.split.train)
        photos: dict[str, Any] = {"split": split, "evaluated_photos": len(evaluated)}
        photos["seen_in_training"] = sum(photo.name in trained for photo in evaluated)
        if self._fits_looks(split):
            photos["colors"] = PROTOCOL
        if scorer is None:
            return photos
        mask = f"predictions are 0 outside the foreground masks of {masked} of {len(evaluated)} photos"
        words = scorer.protocol(mask if masked else "none")
        if words["prompts_without_photos"]:
            say(
                f"no evaluated photo shows {', '.join(words['prompts_without_photos'])}; `lang3dxl "
                f"evaluate run --split seen` scores the labeled training photos"
            )
        return photos | words


@torch.no_grad()
def score_photos(
    run: Training,
    data: TrainingData,
    names: Sequence[str],
    scorer: LanguageScorer | None = None,
    fits_looks: bool = False,
) -> Iterator[EvaluatedPhoto]:
    """Render photos by name as the run shows them now, and score them, with a progress bar. They need not be
    the run's own, but are in its frame. `scorer` scores words, and `fits_looks` applies the half-image
    protocol. Raises UserError if no photo can be read, or if words are wanted that the run does not have."""
    photos = _Photos(run, data, scorer)
    if scorer is not None:
        photos.lift_labels(names)
    for number, (view, batch) in enumerate(tracked(data.read(names), "evaluating", len(names))):
        if number == 0:  # warm-up, excluded from timing
            photos.score(view, batch)
        evaluated = photos.score(view, batch)
        if fits_looks:
            evaluated.images["fitted"], figures = photos.half_image(view, batch)
            evaluated.metrics = figures | evaluated.metrics
        yield evaluated


class _Photos:
    """Scorer of photos by a copy of a run's present scene."""

    def __init__(self, run: Training, data: TrainingData, scorer: LanguageScorer | None) -> None:
        if scorer is not None and run.carried is None:
            raise UserError(NOT_FINISHED)
        self.run, self.data, self.scorer = run, data, scorer
        encode = None if scorer is None else scorer.encode_texts
        self.scene = snapshot(run, data.record(), encode_texts=encode)
        self.metrics = ImageMetrics()
        decoder, codes = self.scene.decoder, self.scene.codes
        self.picture = None if decoder is None or codes is None else decoder.picture(codes).nan_to_num(0.0)

    def lift_labels(self, names: Sequence[str]) -> None:
        """Prepare the upper limit: the labels themselves, lifted from these photos to the Gaussians."""
        assert self.scorer is not None
        truth, scene = self.scorer.truth, self.scene
        photos = ((self.camera(self.data.views[name]), self.data.photos[name]) for name in names)
        labels = (
            (camera, truths_of(truth, photo, truth.scoring_size(photo.height, photo.width)))
            for camera, photo in photos
        )
        masks = ((camera, {name: t.mask for name, t in truths.items()}) for camera, truths in labels)
        self.limit = label_limit(scene.splats, masks, truth.categories)

    def camera(self, view: PhotoCamera) -> Camera:
        """Return a photo's camera, refined if it was trained on."""
        return view.camera(self.run.pose(view)).detach()

    def score(self, view: PhotoCamera, batch: Batch) -> EvaluatedPhoto:
        """Score a photo."""
        camera, mask = self.camera(view), foreground(batch)
        target = colors_of(batch, self.scene.device)
        start = perf_counter()
        rendering = self.scene.draw(camera, self.picture)
        synchronize()
        seconds = perf_counter() - start
        metrics = {"cc_psnr": corrected_psnr(rendering.rgb, target, mask)}
        metrics |= self.metrics(rendering.rgb, target, mask)
        if (semantics := self.run.parts.semantics) is not None and self.scene.codes is not None:
            assert self.run.settings.decode_size is not None
            side = self.run.settings.decode_size[1]
            metrics |= score_features(self.scene, semantics, camera, batch, side)
        metrics |= {"fps": 1 / seconds, "render_seconds": seconds}
        images = {"img": torch.cat([target, rendering.rgb], dim=1)}
        if rendering.channels is not None:
            images["bottleneck"] = rendering.channels
        evaluated = EvaluatedPhoto(batch["name"], metrics, images, {})
        if self.scorer is not None:
            self._score_words(self.scorer, camera, evaluated, batch)
        return evaluated

    def _score_words(
        self, scorer: LanguageScorer, camera: Camera, evaluated: EvaluatedPhoto, batch: Batch
    ) -> None:
        scene, photo, keep = self.scene, self.data.photos[batch["name"]], foreground(batch)
        size = scorer.truth.scoring_size(photo.height, photo.width)
        start = perf_counter()
        raw = scorer.named(relevancy_maps(scene, camera, scorer.queries.to(scene.device)), size)
        synchronize()
        evaluated.metrics["query_seconds"] = perf_counter() - start
        published = None
        if not scorer.smooths:
            queries = scorer.published_queries.to(scene.device)
            published = scorer.named(relevancy_maps(scene, camera, queries), size)
        variants = scorer.variants(raw, keep, scene.engine.temperature, published)
        teacher = scorer.variants(scorer.teacher_maps(batch["clip_target"], size), keep)[""]
        evaluated.maps = inside(raw, keep)
        truths = truths_of(scorer.truth, photo, map_size(raw))
        evaluated.metrics |= scorer.scores(photo.name, variants | {"teacher_": teacher}, truths)
        evaluated.metrics |= bounds(inside(scorer.named(self.limit(camera), size), keep), truths)

    def half_image(self, view: PhotoCamera, batch: Batch) -> tuple[Float[Tensor, "h w 3"], dict[str, float]]:
        """Score colors by the half-image protocol; see `HalfImageProtocol.measure`."""
        scene, weight = self.scene, self.run.settings.ssim_lambda
        assert scene.looks is not None and scene.background is not None
        protocol = HalfImageProtocol(scene.splats, scene.looks, self.metrics, scene.background, weight)
        return protocol.measure(self.camera(view), colors_of(batch, scene.device), foreground(batch))


def colors_of(batch: Batch, device: torch.device) -> Float[Tensor, "h w 3"]:
    """Return a photo's colors, 0…1."""
    return to_device(batch["image"], device).float() / 255.0


@torch.no_grad()
def score_features(
    scene: Scene, semantics: Semantics, camera: Camera, batch: Batch, longer_side: int
) -> dict[str, float]:
    """Measure agreement with a photo's targets, for the scene and for the mean training feature. Features are
    decoded at this longer side, pixels. There are no figures without targets."""
    if "clip_target" not in batch:
        return {}
    clip, dense, mask = _feature_maps(scene, camera, longer_side, foreground(batch))
    target = batch["clip_target"]
    predicted, weight = match(clip, target, batch["crop_sides"], mask)
    metrics = feature_metrics("clip", predicted, target, semantics.clip_mean, weight)
    if dense is not None and "dense_target" in batch:
        target = resize(batch["dense_target"], (dense.shape[0], dense.shape[1]))
        metrics |= feature_metrics("dense", dense, target, semantics.dense_mean, mask)
    return metrics


def _feature_maps(
    scene: Scene, camera: Camera, longer_side: int, mask: Bool[Tensor, "H W"] | None
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w d"] | None, Float[Tensor, "h w"] | None]:
    """Compute CLIP features, dense features if there are any, and the mask. They are decoded before or after
    compositing, depending on the decoder."""
    decoder, codes = scene.semantics()
    if not decoder.per_gaussian:
        maps = composite(scene.splats, camera, codes)
        maps = resize_nearest(maps, fitted_size(maps.shape, longer_side))
        clip, dense = decoder(maps)
        return clip, dense, None if mask is None else resize_nearest(mask, (maps.shape[0], maps.shape[1]))
    # The last layer is linear, so hidden activations are composited and divided by coverage.
    known = codes.isfinite().all(1, keepdim=True)
    hidden = torch.where(known, decoder.hidden(torch.where(known, codes, 0.0)), 0.0)
    maps = composite(scene.splats, camera, torch.cat([hidden, known.to(hidden)], dim=1))
    size = fitted_size(maps.shape, longer_side)
    maps = resize_nearest(maps, size)
    clip, head = maps[..., :-1] / maps[..., -1:].clamp_min(1e-3), decoder.clip_head()
    small_mask = None if mask is None else resize_nearest(mask, size)
    return clip if head is None else F.linear(clip, *head), None, small_mask
