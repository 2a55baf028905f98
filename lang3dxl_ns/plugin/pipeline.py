"""Pipeline: data manager and model, evaluation, and readable errors."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch import Tensor

from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import host_peak, progress_bar, synchronize
from lang3dxl_ns.evaluation.aggregate import average
from lang3dxl_ns.evaluation.annotations import Truth
from lang3dxl_ns.evaluation.ground_truth import GroundTruth, Layout, find_ground_truth
from lang3dxl_ns.evaluation.language import LanguageScorer, open_scorer
from lang3dxl_ns.evaluation.scores import Maps, bounds, inside, map_size, resized
from lang3dxl_ns.plugin.answering import RenderedAnswers
from lang3dxl_ns.plugin.datamanager import Lang3DXLDataManager
from lang3dxl_ns.plugin.datamanager_config import Lang3DXLDataManagerConfig
from lang3dxl_ns.plugin.eval_photos import EvalPhotos
from lang3dxl_ns.plugin.evaluated_photo import EvaluatedPhoto
from lang3dxl_ns.plugin.half_image import PROTOCOL, half_image
from lang3dxl_ns.plugin.handover import Batch
from lang3dxl_ns.plugin.label_limit import label_limit
from lang3dxl_ns.plugin.lift_features import learn_from_photos
from lang3dxl_ns.plugin.load_scene import NOT_FINISHED, describe_scene, scene_of_model
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.plugin.model_config import Lang3DXLModelConfig
from lang3dxl_ns.plugin.plain_errors import print_user_errors_plainly
from lang3dxl_ns.plugin.viewer.panel import AskPanel
from lang3dxl_ns.query.answer import Asked
from lang3dxl_ns.query.engine import QueryEngine, make_engine
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.run_file import SCENE_FILE, SceneFile
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.scene.photo import Photo

QUERY_VARIABLE = "LANG3DXL_QUERY"
Split = Literal["held-out", "seen", "test"]
_COLORS_OF_LIGHT = ("psnr", "ssim", "lpips")
"""Image metrics that are meaningless where views are lit differently from the photos."""


@dataclass
class Lang3DXLPipelineConfig(VanillaPipelineConfig):
    """Configuration of the pipeline."""

    _target: type = field(default_factory=lambda: Lang3DXLPipeline)
    datamanager: Lang3DXLDataManagerConfig = field(default_factory=Lang3DXLDataManagerConfig)
    model: Lang3DXLModelConfig = field(default_factory=Lang3DXLModelConfig)
    ground_truth: Path | None = None
    """Folder of ground truth, in any of the layouts of docs/evaluation.md: `ns-eval` then reports how well
    words find their pixels. Default: ground_truth/ or label/ in the data folder, or label/<scene> beside it,
    if present."""
    ground_truth_layout: Layout | Literal["auto"] = "auto"
    """HolyScenes' masks, LERF-OVS' and PT-OVS' labels, or plain masks; "auto" detects it."""
    evaluated_photos: Split = "held-out"
    """Photos that `ns-eval` evaluates: those held out of training (and the scene's test views, if any); the
    training photos with ground truth (the main tables of HolyScenes use photos seen in training); or the test
    views alone."""
    query: str = ""
    """Prompts for `ns-render` ("rose window; dome"), and the viewer's initial ones; the environment variable
    LANG3DXL_QUERY overrides it."""


Score = Callable[[Cameras, "EvaluatedPhoto", Batch, Photo], None]
"""Adds word scores to an evaluated photo."""


class Lang3DXLPipeline(VanillaPipeline):
    """nerfstudio's pipeline; loads checkpoints strictly, evaluates colors, features and words."""

    config: Lang3DXLPipelineConfig
    datamanager: Lang3DXLDataManager
    model: Lang3DXLModel
    _engine: QueryEngine | None = None
    """Of the current evaluation."""
    last_losses: dict[str, Tensor]
    """The weighted losses of the latest training step."""

    def __init__(self, *args, **kwargs):
        print_user_errors_plainly()
        super().__init__(*args, **kwargs)
        self.panel = AskPanel(self)  # nerfstudio's viewer looks for controls here

    # ── evaluation ──────────────────────────────────────────────────────────────────────────────────

    @cached_property
    def scorer(self) -> LanguageScorer | None:
        """Scores words in photos, if the scene has ground truth and the run has semantics."""
        folder = self.config.ground_truth or find_ground_truth(self.datamanager.data_folder)
        if folder is None or self.model.semantic_field is None:
            return None
        truth = GroundTruth(folder, self.config.ground_truth_layout)
        self._check_labels(truth)
        return open_scorer(truth, self.datamanager.config.clip, self.device)

    @cached_property
    def _test_scorer(self) -> LanguageScorer | None:
        """Scores words in the test views."""
        views = self.datamanager.test_views
        if views is None or self.model.semantic_field is None:
            return None
        truth = GroundTruth(views.folder / "ground_truth", "plain")
        return open_scorer(truth, self.datamanager.config.clip, self.device)

    def _scorer_of(self, split: Split) -> LanguageScorer | None:
        return self._test_scorer if split == "test" else self.scorer

    def _check_labels(self, truth: GroundTruth) -> None:
        """Labels must belong to photos of the scene, each to one; warns of labels without a photo."""
        named: dict[str, str] = {}
        for name in self.datamanager.photos:
            key = truth.key(name)
            if key is not None and named.setdefault(key, name) != name:
                raise UserError(
                    f"the label {key} in {truth.folder} fits both {named[key]} and {name}: name labels with "
                    f"their photos' folders"
                )
        absent = [photo for photo in truth.labeled if photo not in named]
        if not named:
            raise UserError(
                f"no label in {truth.folder} belongs to a photo of the scene: labels are named like photos, "
                f"but the first are {absent[0]} and {next(iter(self.datamanager.photos))}"
            )
        if absent:
            CONSOLE.log(
                f"[yellow]{len(absent)} labels in {truth.folder} belong to no photo of the scene and are not "
                f"scored:[/yellow] {escape(some(absent))}"
            )

    @torch.no_grad()
    def evaluate(self, split: Split | None = None) -> Iterator[EvaluatedPhoto]:
        """Render and score the photos of a split (by default the configured one), with a progress bar."""
        self.eval()
        self._engine = None
        split = split or self.config.evaluated_photos
        photos, score = self._photos_of(split), None
        scorer = self._scorer_of(split)
        if scorer is not None:
            score = partial(self._score_words, scorer, self._label_limit(scorer, photos))
        views = self.datamanager.test_views if split == "test" else None
        hidden = () if views is None or views.same_light else _COLORS_OF_LIGHT
        warm = False
        with progress_bar() as bar:
            for camera, batch in bar.track(photos, total=len(photos), description="evaluating"):
                photo = photos.dataset.photos[batch["image_idx"]]
                if not warm:  # warm-up, excluded from timing
                    self._evaluate_photo(camera, batch, photo, score)
                    warm = True
                evaluated = self._evaluate_photo(camera, batch, photo, score)
                for name in hidden:
                    evaluated.metrics.pop(name, None)
                if self._fits_looks(split):
                    fitted = half_image(self.model, camera, batch)
                    evaluated.metrics = fitted.figures | evaluated.metrics
                    evaluated.images["fitted"] = fitted.rendering
                yield evaluated
        self.train()

    def _fits_looks(self, split: Split) -> bool:
        """Whether the half-image protocol applies: photos may have looks, and those of the split are not
        known from training."""
        return self.model.appearance is not None and split != "seen"

    def _photos_of(self, split: Split) -> EvalPhotos:
        if split == "held-out":
            return self.datamanager.fixed_indices_eval_dataloader
        if split == "test":
            return EvalPhotos(self.datamanager, self.datamanager.test_dataset)
        if self.scorer is None:
            raise UserError("seen photos can be evaluated only with ground truth and CLIP")
        seen = self.datamanager.train_dataset
        labeled = [photo.name for photo in seen.photos if self.scorer.truth.key(photo.name) is not None]
        if not labeled:
            raise UserError(f"none of the training photos has a label in {self.scorer.truth.folder}")
        return EvalPhotos(self.datamanager, seen, labeled)

    def _label_limit(self, scorer: LanguageScorer, photos: EvalPhotos) -> Callable[[Cameras], Maps]:
        """Maps of the labels themselves, lifted from the photos to the Gaussians."""
        truth = scorer.truth

        def labels():
            for camera, photo in photos.cameras():
                truths = _truths(truth, photo, truth.scoring_size(photo.height, photo.width))
                yield camera, {category: found.mask for category, found in truths.items()}

        return label_limit(self.model, labels(), truth.categories)

    def _evaluate_photo(self, camera, batch: Batch, photo: Photo, score: Score | None) -> EvaluatedPhoto:
        start = perf_counter()
        self.model.set_crop(None)
        outputs = self.model.get_outputs(camera)
        synchronize()
        seconds = perf_counter() - start
        metrics, images = self.model.get_image_metrics_and_images(outputs, batch)
        metrics |= self.model.feature_metrics(camera, batch)
        metrics |= {"fps": 1 / seconds, "render_seconds": seconds}
        evaluated = EvaluatedPhoto(batch["name"], metrics, images, {}, "mask" in batch)
        if score is not None:
            score(camera, evaluated, batch, photo)
        return evaluated

    def _score_words(
        self,
        scorer: LanguageScorer,
        limit: Callable[[Cameras], Maps],
        camera: Cameras,
        evaluated: EvaluatedPhoto,
        batch: Batch,
        photo: Photo,
    ) -> None:
        size = scorer.truth.scoring_size(photo.height, photo.width)
        keep = batch["mask"][..., 0] if "mask" in batch else None
        start = perf_counter()
        asked = scorer.queries.to(self.device)
        raw = scorer.named(self.relevancy(camera, asked, scorer.yardstick), size)
        synchronize()
        evaluated.metrics["query_seconds"] = perf_counter() - start
        published = None
        if not scorer.smooths:
            queries = scorer.published_queries.to(self.device)
            published = scorer.named(self.relevancy(camera, queries, scorer.yardstick), size)
        assert self._engine is not None
        variants = scorer.variants(raw, keep, self._engine.temperature, published)
        teacher = scorer.variants(scorer.teacher_maps(batch["clip_target"], size), keep)[""]
        evaluated.maps = inside(raw, keep)
        truths = _truths(scorer.truth, photo, map_size(raw))
        evaluated.metrics |= scorer.scores_of(photo.name, variants | {"teacher_": teacher}, truths)
        evaluated.metrics |= bounds(inside(resized(limit(camera), size), keep), truths)

    @torch.no_grad()
    def relevancy(self, camera, queries: Queries, yardstick: Queries) -> Tensor:
        """Relevancy of every pixel to every prompt [q, h, w], calibrated by the words of a yardstick."""
        if self._engine is None:
            encoder, carried = self.model.semantic_field, self.model.carried
            if encoder is None or carried is None:
                raise UserError(NOT_FINISHED)
            words = yardstick.to(self.device)
            self._engine = make_engine(encoder, carried.detach()).calibrated(words)
        _, rendered = self.model.render(camera, self._engine.carried(queries))
        assert rendered is not None
        return self._engine.maps(rendered, queries)

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """`scored`, for `ns-eval` and the trainer; the figures are printed as well for `ns-eval`."""
        results = self.scored(output_path, get_std)
        if get_std:
            means = {n: v for n, v in results.items() if isinstance(v, float) and not n.endswith("_std")}
            say(*(f"{name:24} {value:10.4g}" for name, value in means.items()))
        return results

    def scored(self, output_path: Path | None = None, get_std: bool = False) -> dict[str, Any]:
        """Means and totals over the evaluated photos, and `peak_memory_mb` of the process (or of the GPU, if
        one is used); see `evaluation.aggregate.average`.

        output_path: folder for a picture of every photo, optional.
        get_std: adds standard deviations, `protocol` (what was scored, and how),
            `photos` (the figures of each), and with held-out photos the same for the scene's `test_views`.
        """
        results = self._averages(self.config.evaluated_photos, output_path, get_std)
        results["peak_memory_mb"] = _peak_memory(self.device) / 2**20
        beside = self.config.evaluated_photos == "held-out" and self.datamanager.test_views is not None
        if get_std and beside:
            results["test_views"] = self._averages("test", output_path, get_std)
        return results

    def _averages(self, split: Split, output_path: Path | None, get_std: bool) -> dict[str, Any]:
        evaluated = []
        for photo in self.evaluate(split):
            if output_path is not None:
                photo.write_pictures(output_path)
            photo.images, photo.maps = {}, {}  # too large for all photos
            evaluated.append(photo)
        results = average([photo.metrics for photo in evaluated], get_std)
        if get_std:
            results["protocol"] = self._protocol(split, evaluated)
            results["photos"] = {photo.name: photo.metrics for photo in evaluated}
        return results

    def _protocol(self, split: Split, evaluated: list[EvaluatedPhoto]) -> dict[str, Any]:
        scorer = self._scorer_of(split)
        trained = {photo.name for photo in self.datamanager.train_dataset.photos}
        seen, masked = (sum(p.name in trained for p in evaluated), sum(p.masked for p in evaluated))
        photos: dict[str, Any] = {
            "split": split,
            "evaluated_photos": len(evaluated),
            "seen_in_training": seen,
        }
        if self._fits_looks(split):
            photos["colors"] = PROTOCOL
        mask = f"predictions are 0 outside the foreground masks of {masked} of {len(evaluated)} photos"
        if scorer is None:
            return photos
        words = scorer.protocol(mask if masked else "none")
        if words["prompts_without_photos"]:
            CONSOLE.log(
                f"[yellow]no evaluated photo shows {', '.join(words['prompts_without_photos'])}; `lang3dxl "
                f"evaluate run --split seen` scores the labeled training photos"
            )
        return photos | words

    def get_train_loss_dict(self, step: int):
        """Outputs, losses and metrics of the next photo."""
        outputs, self.last_losses, metrics = super().get_train_loss_dict(step)
        return outputs, self.last_losses, metrics

    @property
    def query(self) -> str:
        """The prompts for renderings."""
        return os.environ.get(QUERY_VARIABLE) or self.config.query

    @cached_property
    def scene_file(self) -> SceneFile:
        """The photos' names and cameras, and the CLIP."""
        run = self.datamanager.config.run
        if run is not None and (run / SCENE_FILE).is_file():
            return SceneFile.read(run / SCENE_FILE)
        return describe_scene(self.datamanager)

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint; for rendering, also prepare to answer the configured prompts."""
        super().load_pipeline(loaded_state, step)
        if self.test_mode != "val" and self.query:
            self.model.answers = RenderedAnswers(self._asked())

    def match_thresholds(self) -> dict[str, float]:
        """Relevancy above which places match each scored prompt, by the scene."""
        prompts = [] if self.scorer is None else self.scorer.truth.categories
        if not prompts or self.model.carried is None:
            return {}
        scene = scene_of_model(self.model, self.scene_file, None)
        return dict(zip(prompts, scene.thresholds([Prompt(text) for text in prompts]), strict=True))

    def _asked(self) -> Asked:
        scene = scene_of_model(self.model, self.scene_file, self.datamanager.config.run)
        CONSOLE.log(f"Looking for {escape(self.query)}")
        prompts = scene.prompts(self.query)
        queries, thresholds = scene.queries(prompts), scene.thresholds(prompts)
        return Asked(scene.engine, queries, min_alpha=scene.config.min_alpha, thresholds=thresholds)

    @property
    def has_words_to_learn(self) -> bool:
        """Whether semantics are learned after the last iteration, not from renderings."""
        return self.model.semantic_field is not None and self.model.semantic_field.needs_lifting

    def learn_words(self) -> None:
        """Gather the training photos' features onto the present Gaussians, and learn codes."""
        encoder = self.model.semantic_field
        assert encoder is not None
        training = self.model.training
        self.model.train()
        photos = self.datamanager.train_photos()
        with progress_bar() as bar:
            total = len(self.datamanager.train_dataset)
            gathering = bar.track(photos, total=total, description="gathering features")
            learning = bar.add_task("learning codes", total=encoder.learning_steps or None)
            learn_from_photos(self.model, gathering, lambda: bar.advance(learning))
        self.model.train(training)

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool | None = None) -> None:  # type: ignore[override]
        """Load a checkpoint; any mismatch is an error (nerfstudio would silently ignore it)."""
        state = {key.removeprefix("_model."): v for key, v in state_dict.items() if key.startswith("_model.")}
        try:
            self.model.load_state_dict(state, strict=True)
        except (RuntimeError, KeyError) as error:
            raise UserError(
                f"the checkpoint does not fit this configuration: {error}. "
                f"Load it with the config.yml beside it, or with the options that it was trained with"
            ) from error


def _truths(truth: GroundTruth, photo: Photo, size: tuple[int, int]) -> dict[str, Truth]:
    """The photo's labels, undistorted like the photo, on whose file they were drawn. (Boxes no longer
    fit then, so masks take their place.)"""
    truths = truth.truths(photo.name, size)
    if not photo.lens.distorts:
        return truths
    masks = {category: torch.from_numpy(found.mask).int() for category, found in truths.items()}
    return {category: Truth(photo.undistort_labels(mask).numpy() == 1) for category, mask in masks.items()}


def _peak_memory(device: torch.device | str) -> int:
    return torch.cuda.max_memory_allocated() if torch.device(device).type == "cuda" else host_peak()
