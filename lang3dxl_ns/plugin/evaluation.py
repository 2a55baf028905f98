"""Evaluation of a run: renders the photos of a split and scores their colors, features and words."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from lang3dxl_ns.common.console import say, tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import host_peak, synchronize
from lang3dxl_ns.evaluation.aggregate import average
from lang3dxl_ns.evaluation.ground_truth import GroundTruth, Layout, find_ground_truth
from lang3dxl_ns.evaluation.half_image import PROTOCOL, HalfImageProtocol
from lang3dxl_ns.evaluation.label_limit import label_limit
from lang3dxl_ns.evaluation.photo_metrics import EvaluatedPhoto
from lang3dxl_ns.evaluation.score_scene import truths_of
from lang3dxl_ns.evaluation.scores import LanguageScorer, bounds, inside, map_size, open_scorer
from lang3dxl_ns.plugin.cameras import to_rasterizer
from lang3dxl_ns.plugin.datamanager import Lang3DXLDataManager
from lang3dxl_ns.plugin.dataparser import RecordedSceneDataParserConfig
from lang3dxl_ns.plugin.load_scene import NOT_FINISHED
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.plugin.photo_dataset import EvalPhotos
from lang3dxl_ns.preparation.targets import Batch, foreground
from lang3dxl_ns.query.engine import QueryEngine, make_engine
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.scene.camera import Camera
from lang3dxl_ns.scene.photo import Photo

Split = Literal["held-out", "seen"]
Score = Callable[[Cameras, EvaluatedPhoto, Batch, Photo], None]
"""Function that adds word scores to an evaluated photo."""
LabelLimit = Callable[[Camera], Float[Tensor, "categories h w"]]


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

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore settings from config.yml. An earlier version had another choice of photos."""
        if state.get("evaluated_photos") == "test":
            say("The run's setting evaluated_photos: test no longer exists: held-out photos are evaluated")
            state = state | {"evaluated_photos": "held-out"}
        self.__dict__.update(state)


class Evaluation:
    """Scores of a model, trained or still in training, on photos of its scene, which the data manager reads
    with their targets, against the ground truth of the settings."""

    def __init__(
        self, model: Lang3DXLModel, datamanager: Lang3DXLDataManager, settings: EvaluationSettings
    ) -> None:
        self._model, self._data, self._settings = model, datamanager, settings
        self._engine: QueryEngine | None = None
        """Query engine of the current evaluation."""

    @cached_property
    def scorer(self) -> LanguageScorer | None:
        """Scorer of words in photos; None if the scene has no ground truth or the run has no semantics."""
        folder = self._settings.ground_truth or find_ground_truth(self._data.data_folder)
        if folder is None or self._model.semantic_field is None:
            return None
        truth = GroundTruth(folder, self._settings.ground_truth_layout)
        truth.check(self._data.photos)
        return open_scorer(truth, self._data.config.clip, self._model.device)

    def evaluate(self, split: Split | None = None) -> Iterator[EvaluatedPhoto]:
        """Render and score the photos of a split (default: the configured one), with a progress bar."""
        split = split or self._settings.evaluated_photos
        if isinstance(self._data.config.dataparser, RecordedSceneDataParserConfig):
            raise UserError(
                "this run can't be evaluated without the photos that it was trained on (see above): restore "
                "them, or correct data in its config.yml. `lang3dxl evaluate run NAME.scene --ground-truth "
                "FOLDER` scores its words alone"
            )
        return self.evaluate_photos(self._photos_of(split), self.scorer, self._fits_looks(split))

    @torch.no_grad()
    def evaluate_photos(
        self, photos: EvalPhotos, scorer: LanguageScorer | None, fits_looks: bool = False
    ) -> Iterator[EvaluatedPhoto]:
        """Render photos and score them, their words by a scorer, with a progress bar; `fits_looks` applies
        the half-image protocol."""
        self._model.eval()
        self._engine, score = None, None
        if scorer is not None:
            score = partial(self._score_words, scorer, self._label_limit(scorer, photos))
        for number, (camera, batch) in enumerate(tracked(photos, "evaluating", len(photos))):
            photo = photos.dataset.photos[batch["image_idx"]]
            if number == 0:  # warm-up, excluded from timing
                self._evaluate_photo(camera, batch, photo, score)
            evaluated = self._evaluate_photo(camera, batch, photo, score)
            if fits_looks:
                evaluated.images["fitted"], figures = self._half_image(camera, batch)
                evaluated.metrics = figures | evaluated.metrics
            yield evaluated
        self._model.train()

    def _fits_looks(self, split: Split) -> bool:
        """Return whether the half-image protocol applies: to held-out photos, whose looks are unknown."""
        return self._model.appearance is not None and split == "held-out"

    def _half_image(self, camera: Cameras, batch: Batch) -> tuple[Float[Tensor, "h w 3"], dict[str, float]]:
        model = self._model
        assert model.appearance is not None
        background, weight = model._get_background_color(), model.config.ssim_lambda
        protocol = HalfImageProtocol(
            model.splats(), model.appearance, model.image_metrics, background, weight, model.backend
        )
        photo = model.get_gt_img(batch["image"])
        return protocol.measure(to_rasterizer(camera), photo, foreground(batch))

    def _photos_of(self, split: Split) -> EvalPhotos:
        if split != "seen":
            return self._data.evaluated()
        if self.scorer is None:
            raise UserError("seen photos can be evaluated only with ground truth and CLIP")
        seen = self._data.train_dataset
        labeled = [photo.name for photo in seen.photos if self.scorer.truth.key(photo.name) is not None]
        if not labeled:
            raise UserError(f"none of the training photos has a label in {self.scorer.truth.folder}")
        return self._data.evaluated(seen, labeled)

    def _label_limit(self, scorer: LanguageScorer, photos: EvalPhotos) -> LabelLimit:
        """Build a function that renders the labels themselves, lifted from the photos to the Gaussians."""
        truth = scorer.truth
        sized = ((camera, p, truth.scoring_size(p.height, p.width)) for camera, p in photos.cameras())
        labels = ((to_rasterizer(camera), truths_of(truth, photo, size)) for camera, photo, size in sized)
        masks = ((view, {name: t.mask for name, t in truths.items()}) for view, truths in labels)
        return label_limit(self._model.splats(), masks, truth.categories, self._model.backend)

    def _evaluate_photo(self, camera, batch: Batch, photo: Photo, score: Score | None) -> EvaluatedPhoto:
        start = perf_counter()
        self._model.set_crop(None)
        outputs = self._model.get_outputs(camera)
        synchronize()
        seconds = perf_counter() - start
        metrics, images = self._model.get_image_metrics_and_images(outputs, batch)
        metrics = {"cc_psnr": self._model.corrected_psnr(outputs, batch)} | metrics
        metrics |= self._model.feature_metrics(camera, batch)
        metrics |= {"fps": 1 / seconds, "render_seconds": seconds}
        evaluated = EvaluatedPhoto(batch["name"], metrics, images, {}, photo.mask_path is not None)
        if score is not None:
            score(camera, evaluated, batch, photo)
        return evaluated

    def _score_words(
        self,
        scorer: LanguageScorer,
        limit: LabelLimit,
        camera: Cameras,
        evaluated: EvaluatedPhoto,
        batch: Batch,
        photo: Photo,
    ) -> None:
        size = scorer.truth.scoring_size(photo.height, photo.width)
        keep = foreground(batch)
        start = perf_counter()
        asked = scorer.queries.to(self._model.device)
        raw = scorer.named(self.relevancy(camera, asked, scorer.yardstick), size)
        synchronize()
        evaluated.metrics["query_seconds"] = perf_counter() - start
        published = None
        if not scorer.smooths:
            queries = scorer.published_queries.to(self._model.device)
            published = scorer.named(self.relevancy(camera, queries, scorer.yardstick), size)
        assert self._engine is not None
        variants = scorer.variants(raw, keep, self._engine.temperature, published)
        teacher = scorer.variants(scorer.teacher_maps(batch["clip_target"], size), keep)[""]
        evaluated.maps = inside(raw, keep)
        truths = truths_of(scorer.truth, photo, map_size(raw))
        evaluated.metrics |= scorer.scores(photo.name, variants | {"teacher_": teacher}, truths)
        lifted = scorer.named(limit(to_rasterizer(camera)), size)
        evaluated.metrics |= bounds(inside(lifted, keep), truths)

    @torch.no_grad()
    def relevancy(self, camera: Cameras, queries: Queries, yardstick: Queries) -> Float[Tensor, "q h w"]:
        """Compute every pixel's relevancy to every prompt, calibrated by a yardstick's words."""
        model = self._model
        if self._engine is None:
            if model.semantic_field is None or model.carried is None:
                raise UserError(NOT_FINISHED)
            engine = make_engine(model.semantic_field, model.carried.detach())
            self._engine = engine.calibrated(yardstick.to(model.device))
        rendering = model.seen(camera, channels=self._engine.channels(queries))
        assert rendering.channels is not None
        return self._engine.maps(rendering.channels, queries)

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
        on_gpu = torch.device(self._model.device).type == "cuda"
        results["peak_memory_mb"] = (torch.cuda.max_memory_allocated() if on_gpu else host_peak()) / 2**20
        if get_std:
            results["protocol"] = self._protocol(evaluated)
            results["photos"] = {photo.name: photo.metrics for photo in evaluated}
        return results

    def _protocol(self, evaluated: list[EvaluatedPhoto]) -> dict[str, Any]:
        scorer, masked = self.scorer, sum(photo.masked for photo in evaluated)
        split = self._settings.evaluated_photos
        trained = {photo.name for photo in self._data.train_dataset.photos}
        photos: dict[str, Any] = {"split": split, "evaluated_photos": len(evaluated)}
        photos["seen_in_training"] = sum(photo.name in trained for photo in evaluated)
        if self._fits_looks(split):
            photos["colors"] = PROTOCOL
        if scorer is None:
            return photos
        mask = f"predictions are 0 outside the foreground masks of {masked} of {len(evaluated)} photos"
        words = scorer.protocol(mask if masked else "none")
        if words["prompts_without_photos"]:
            CONSOLE.log(
                f"[yellow]no evaluated photo shows {', '.join(words['prompts_without_photos'])}; `lang3dxl "
                f"evaluate run --split seen` scores the labeled training photos"
            )
        return photos | words
