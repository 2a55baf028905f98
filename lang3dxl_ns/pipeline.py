"""The pipeline: data manager and model together, with errors that a person can read."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import Any, Literal

import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from rich.markup import escape
from torch import Tensor

from lang3dxl_ns.datamanager import EvalPhotos, Lang3DXLDataManager, Lang3DXLDataManagerConfig
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.aggregate import average
from lang3dxl_ns.evaluation.annotations import Truth
from lang3dxl_ns.evaluation.ground_truth import GroundTruth, Layout, find_ground_truth
from lang3dxl_ns.evaluation.language import LanguageScorer, open_scorer
from lang3dxl_ns.evaluation.report import host_peak, progress_bar, synchronize
from lang3dxl_ns.evaluation.scores import Maps, map_size
from lang3dxl_ns.lift_features import lift_features
from lang3dxl_ns.model import Lang3DXLModel
from lang3dxl_ns.model_config import Lang3DXLModelConfig
from lang3dxl_ns.older_config import ReadsOlder
from lang3dxl_ns.preparation.photo import Photo
from lang3dxl_ns.preparation.progress import some
from lang3dxl_ns.query.answer import Asked, ClipColours
from lang3dxl_ns.query.relevancy import TEMPERATURE
from lang3dxl_ns.query.scene_file import SCENE_FILE, SceneFile
from lang3dxl_ns.scene_loading import describe_scene, scene_of_model
from lang3dxl_ns.viewer.panel import AskPanel

QUERY_VARIABLE = "LANG3DXL_QUERY"


@dataclass
class Lang3DXLPipelineConfig(ReadsOlder, VanillaPipelineConfig):
    """Configuration of the pipeline."""

    _target: type = field(default_factory=lambda: Lang3DXLPipeline)
    datamanager: Lang3DXLDataManagerConfig = field(default_factory=Lang3DXLDataManagerConfig)
    model: Lang3DXLModelConfig = field(default_factory=Lang3DXLModelConfig)
    ground_truth: Path | None = None
    """Folder of ground truth, in any of the layouts of docs/evaluation.md: `ns-eval` then reports how well
    words find their pixels. Default: ground_truth/ or label/ in the data folder, or label/<scene> beside it,
    if there."""
    ground_truth_layout: Layout | Literal["auto"] = "auto"
    """HolyScenes' masks, LERF-OVS' and PT-OVS' labels, or plain masks; "auto" looks."""
    evaluated_photos: Literal["held-out", "seen"] = "held-out"
    """Which photos `ns-eval` looks at: those held out of training, or those of the training photos that have
    ground truth (the main tables of HolyScenes are of photos that training saw)."""
    query: str = ""
    """What `ns-render` looks for ("rose window; dome"), and the viewer at first; the environment variable
    LANG3DXL_QUERY overrules it."""


@dataclass
class EvaluatedPhoto:
    """A photo that was evaluated: its figures, and the pictures behind them."""

    name: str
    metrics: dict[str, float]
    """psnr …, `render_seconds`, and with ground truth `query_seconds` and the figures of
    `evaluation.aggregate.average`: `ap_{category}` …, with the prefixes raw_, authors_ and teacher_."""
    images: dict[str, Tensor]
    """`img` (photo beside rendering, [H, 2W, 3]) and, with semantics, `bottleneck`."""
    field_maps: Maps
    """Relevancy by category as scored without prefix: blurred, at half the photo's size; empty without
    ground truth."""
    teacher_maps: Maps
    """The same of the photo's own CLIP target."""
    masked: bool = False
    """Whether the maps are cut by a foreground mask."""


class Lang3DXLPipeline(VanillaPipeline):
    """nerfstudio's pipeline; loads checkpoints strictly, evaluates colours, features and words."""

    config: Lang3DXLPipelineConfig
    datamanager: Lang3DXLDataManager
    model: Lang3DXLModel
    last_losses: dict[str, Tensor]
    """The weighted losses of the latest training step."""

    def __init__(self, *args, **kwargs):
        print_user_errors_plainly()
        super().__init__(*args, **kwargs)
        self.panel = AskPanel(self)  # nerfstudio's viewer looks for it here

    # ── evaluation ──────────────────────────────────────────────────────────────────────────────────

    @cached_property
    def scorer(self) -> LanguageScorer | None:
        """Scores words where the scene has ground truth and the run has semantics."""
        folder = self.config.ground_truth or find_ground_truth(self.datamanager.data_folder)
        if folder is None or self.model.semantic_field is None:
            return None
        truth = GroundTruth(folder, self.config.ground_truth_layout)
        self._check_labels(truth)
        return open_scorer(truth, self.datamanager.config.clip, self.device)

    def _check_labels(self, truth: GroundTruth) -> None:
        """Labels must belong to photos of the scene, each to one; says which photos the scene lacks."""
        named: dict[str, str] = {}
        for name in self.datamanager.photos:
            key = truth.key(name)
            if key is not None and named.setdefault(key, name) != name:
                raise UserError(
                    f"the label {key} in {truth.folder} fits both {named[key]} and {name}: name labels with "
                    f"the folders of their photos"
                )
        absent = [photo for photo in truth.labelled if photo not in named]
        if not named:
            raise UserError(
                f"no label in {truth.folder} belongs to a photo of the scene: labels are named like photos, "
                f"and the first are {absent[0]} and {next(iter(self.datamanager.photos))}"
            )
        if absent:
            CONSOLE.log(
                f"[yellow]{len(absent)} labels in {truth.folder} belong to no photo of the scene and are not "
                f"scored:[/yellow] {escape(some(absent))}"
            )

    @torch.no_grad()
    def evaluate(self) -> Iterator[EvaluatedPhoto]:
        """Render the photos to evaluate and compare, one at a time, with a progress bar."""
        self.eval()
        photos, warm = self._evaluated_photos(), False
        with progress_bar() as bar:
            for camera, batch in bar.track(photos, total=len(photos), description="evaluating"):
                photo = photos.dataset.photos[batch["image_idx"]]
                if not warm:  # the first photo loads kernels, which is no photo's time
                    self._evaluate_photo(camera, batch, photo)
                    warm = True
                yield self._evaluate_photo(camera, batch, photo)
        self.train()

    def _evaluated_photos(self) -> EvalPhotos:
        if self.config.evaluated_photos == "held-out":
            return self.datamanager.fixed_indices_eval_dataloader
        if self.scorer is None:
            raise UserError("photos that training saw are evaluated where there is ground truth, and CLIP")
        seen = self.datamanager.train_dataset
        labelled = [photo.name for photo in seen.photos if self.scorer.truth.key(photo.name) is not None]
        if not labelled:
            raise UserError(f"none of the training photos has a label in {self.scorer.truth.folder}")
        return EvalPhotos(self.datamanager, seen, labelled)

    def _evaluate_photo(self, camera, batch: dict, photo: Photo) -> EvaluatedPhoto:
        start = perf_counter()
        self.model.set_crop(None)
        outputs = self.model.get_outputs(camera)
        synchronize()
        seconds = perf_counter() - start
        metrics, images = self.model.get_image_metrics_and_images(outputs, batch)
        metrics |= {"fps": 1 / seconds, "render_seconds": seconds}
        evaluated = EvaluatedPhoto(batch["name"], metrics, images, {}, {}, "mask" in batch)
        if self.scorer is not None:
            self._score_words(evaluated, batch, photo)
        return evaluated

    def _score_words(self, evaluated: EvaluatedPhoto, batch: dict, photo: Photo) -> None:
        scorer, field_ = self.scorer, self.model.semantic_field
        assert scorer is not None and field_ is not None
        size = scorer.truth.scoring_size(photo.height, photo.width)
        keep = batch["mask"][..., 0] if "mask" in batch else None
        start = perf_counter()
        raw = scorer.field_maps(field_.decode_clip, self.model.rendered_codes, size)
        synchronize()
        evaluated.metrics["query_seconds"] = perf_counter() - start
        variants = scorer.variants(raw, keep, TEMPERATURE)
        teacher = scorer.variants(scorer.teacher_maps(batch["clip_target"], size), keep)[""]
        evaluated.field_maps, evaluated.teacher_maps = variants[""], teacher
        truths = _truths(scorer.truth, photo, map_size(raw))
        for prefix, maps in (variants | {"teacher_": teacher}).items():
            evaluated.metrics |= scorer.scores(photo.name, maps, prefix, truths)

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Means and totals over the evaluated photos, and `peak_memory_mb` of the process (of the GPU, where
        one is used), for `ns-eval` and the trainer; see `evaluation.aggregate.average`.

        output_path: folder for a picture of every photo, if wanted.
        get_std: as `ns-eval` asks; then also standard deviations, `protocol` (what was scored, and how) and
            `photos` (the figures of each).
        """
        evaluated = []
        for photo in self.evaluate():
            if output_path is not None:
                _write_pictures(photo, output_path)
            photo.images, photo.field_maps, photo.teacher_maps = {}, {}, {}  # all photos' would not fit
            evaluated.append(photo)
        results = average([photo.metrics for photo in evaluated], get_std)
        results["peak_memory_mb"] = _peak_memory(self.device) / 2**20
        if get_std:
            results["protocol"] = self._protocol(evaluated)
            results["photos"] = {photo.name: photo.metrics for photo in evaluated}
        return results

    def _protocol(self, evaluated: list[EvaluatedPhoto]) -> dict[str, Any]:
        trained = {photo.name for photo in self.datamanager.train_dataset.photos}
        seen, masked = (sum(p.name in trained for p in evaluated), sum(p.masked for p in evaluated))
        photos = {"evaluated_photos": len(evaluated), "seen_in_training": seen}
        mask = f"predictions are 0 outside the foreground masks of {masked} of {len(evaluated)} photos"
        if self.scorer is None:
            return photos
        words = self.scorer.protocol(mask if masked else "none")
        if words["prompts_without_photos"]:
            CONSOLE.log(
                f"[yellow]no evaluated photo shows {', '.join(words['prompts_without_photos'])}; `lang3dxl "
                f"evaluate run --split seen` looks at the labelled photos that training saw"
            )
        return photos | words

    def get_train_loss_dict(self, step: int):
        """Outputs, losses and metrics of the next photo."""
        outputs, self.last_losses, metrics = super().get_train_loss_dict(step)
        return outputs, self.last_losses, metrics

    @property
    def query(self) -> str:
        """What is to be looked for in renderings."""
        return os.environ.get(QUERY_VARIABLE) or self.config.query

    @cached_property
    def scene_file(self) -> SceneFile:
        """The photos' names and cameras, and the CLIP."""
        run = self.datamanager.config.run
        if run is not None and (run / SCENE_FILE).is_file():
            return SceneFile.read(run / SCENE_FILE)
        return describe_scene(self.datamanager)

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint; to render, get ready to answer what is asked for."""
        super().load_pipeline(loaded_state, step)
        if self.test_mode != "val" and self.query:
            self.model.answers = self._answers

    def _answers(self, outputs: dict[str, Tensor], codes: Tensor, _seconds: float) -> dict[str, Tensor]:
        return self._asked.outputs(outputs["rgb"], codes, outputs["accumulation"][..., 0])

    @cached_property
    def _asked(self) -> Asked:
        scene = scene_of_model(self.model, self.scene_file, self.datamanager.config.run)
        queries = scene.queries(scene.prompts(self.query))
        CONSOLE.log(f"Looking for {self.query}; lookup table: {scene.lookup}")
        colours = ClipColours.of(scene.decode, scene.rendered_codes())
        return Asked(scene.scorer(), queries, min_alpha=scene.config.min_alpha, colours=colours)

    def finish_training(self) -> None:
        """What is left to do when the last iteration is: lift features, where the encoder learns none."""
        encoder = self.model.semantic_field
        if encoder is None or not encoder.needs_lifting:
            return
        self.model.train()
        photos = self.datamanager.train_photos()
        with progress_bar() as bar:
            total = len(self.datamanager.train_dataset)
            lift_features(self.model, bar.track(photos, total=total, description="lifting features"))

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool | None = None):  # type: ignore[override]
        """Load a checkpoint; whatever does not fit is an error (nerfstudio would silently leave it out)."""
        state = {key.removeprefix("_model."): v for key, v in state_dict.items() if key.startswith("_model.")}
        try:
            self.model.load_state_dict(state, strict=True)
        except (RuntimeError, KeyError) as error:
            raise UserError(
                f"the checkpoint does not fit this configuration: {error}. "
                f"Load it with the config.yml beside it, or with the options that it was trained with"
            ) from error


def _write_pictures(evaluated: EvaluatedPhoto, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in evaluated.images.items():
        pixels = (image.clamp(0, 1) * 255).byte().cpu().numpy()
        Image.fromarray(pixels).save(folder / f"{evaluated.name.replace('/', '_')}.{name}.jpg")


def _truths(truth: GroundTruth, photo: Photo, size: tuple[int, int]) -> dict[str, Truth]:
    """The photo's labels as it is rendered: drawn on the file, they are undistorted with it. (Boxes no longer
    fit then, and the mask takes their place.)"""
    truths = truth.truths(photo.name, size)
    if not (photo.fisheye or any(photo.distortion)):
        return truths
    masks = {category: torch.from_numpy(found.mask).int() for category, found in truths.items()}
    return {category: Truth(photo.undistort_labels(mask).numpy() == 1) for category, mask in masks.items()}


def _peak_memory(device: torch.device | str) -> int:
    return torch.cuda.max_memory_allocated() if torch.device(device).type == "cuda" else host_peak()


_previous_hook = sys.excepthook


def print_user_errors_plainly() -> None:
    """Let a command end on a `UserError` with its message alone, without a traceback."""
    global _previous_hook
    if sys.excepthook is not _print_user_error:
        _previous_hook, sys.excepthook = sys.excepthook, _print_user_error


def _print_user_error(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    if issubclass(kind, UserError):
        CONSOLE.print(f"[bold red]Error:[/bold red] {escape(str(error))}", soft_wrap=True)
    else:
        _previous_hook(kind, error, traceback)
