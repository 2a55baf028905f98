"""The pipeline: data manager and model together, with errors that a person can read."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import Any

import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from rich.markup import escape
from torch import Tensor

from lang3dxl_ns.datamanager import Lang3DXLDataManager, Lang3DXLDataManagerConfig
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.average_precision import deviation_over_photos, mean_over_photos
from lang3dxl_ns.evaluation.holyscenes import GroundTruth, mean_average_precision, scoring_size
from lang3dxl_ns.evaluation.language import LanguageScorer, Maps, blurred, inside, open_scorer
from lang3dxl_ns.evaluation.report import progress_bar
from lang3dxl_ns.model import Lang3DXLModel
from lang3dxl_ns.model_config import Lang3DXLModelConfig
from lang3dxl_ns.older_config import ReadsOlder
from lang3dxl_ns.preparation.progress import some


@dataclass
class Lang3DXLPipelineConfig(ReadsOlder, VanillaPipelineConfig):
    """Configuration of the pipeline."""

    _target: type = field(default_factory=lambda: Lang3DXLPipeline)
    datamanager: Lang3DXLDataManagerConfig = field(default_factory=Lang3DXLDataManagerConfig)
    model: Lang3DXLModelConfig = field(default_factory=Lang3DXLModelConfig)
    ground_truth: Path | None = None
    """Folder of ground truth in HolyScenes' layout, <category>/NNNN-gt.jpg, object black: `ns-eval` then
    reports the average precision of each category. Default: ground_truth/ in the data folder, if there."""


@dataclass
class EvaluatedPhoto:
    """A held-out photo: its figures, and the pictures behind them."""

    name: str
    metrics: dict[str, float]
    """PSNR … and, with ground truth, `ap_{category}`, `raw_ap_{category}` (before the blur) and
    `teacher_ap_{category}`."""
    images: dict[str, Tensor]
    """`img` (photo beside rendering, [H, 2W, 3]) and, with semantics, `semantics`."""
    field_maps: Maps
    """Relevancy by category at half the photo's size, blurred as published; empty without ground truth."""
    teacher_maps: Maps
    """The same of the photo's own CLIP target."""


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

    # ── evaluation ──────────────────────────────────────────────────────────────────────────────────

    @cached_property
    def scorer(self) -> LanguageScorer | None:
        """Scores words where the scene has ground truth and the run has semantics."""
        folder = self.config.ground_truth
        if folder is None:
            folder = self.datamanager.data_folder / "ground_truth"
            if not folder.is_dir():
                return None
        if self.model.semantic_field is None:
            return None
        truth = GroundTruth(folder)
        datasets = (self.datamanager.train_dataset, self.datamanager.eval_dataset)
        unknown = truth.unknown(photo.name for dataset in datasets for photo in dataset.photos)
        if unknown:
            CONSOLE.log(
                f"[yellow]{len(unknown)} masks in {folder} belong to no photo of the scene and are not "
                f"scored:[/yellow] {escape(some(unknown))}"
            )
        return open_scorer(truth, self.datamanager.config.clip, self.device)

    @torch.no_grad()
    def evaluate(self) -> Iterator[EvaluatedPhoto]:
        """Render every held-out photo and compare, one at a time, with a progress bar."""
        self.eval()
        photos = self.datamanager.fixed_indices_eval_dataloader
        with progress_bar() as bar:
            for camera, batch in bar.track(photos, total=len(photos), description="evaluating"):
                yield self._evaluate_photo(camera, batch)
        self.train()

    def _evaluate_photo(self, camera, batch: dict) -> EvaluatedPhoto:
        start = perf_counter()
        outputs = self.model.get_outputs_for_camera(camera)
        seconds = perf_counter() - start
        metrics, images = self.model.get_image_metrics_and_images(outputs, batch)
        metrics["fps"] = 1 / seconds
        evaluated = EvaluatedPhoto(batch["name"], metrics, images, {}, {})
        if self.scorer is not None:
            self._score_words(evaluated, batch)
        return evaluated

    def _score_words(self, evaluated: EvaluatedPhoto, batch: dict) -> None:
        scorer, field_ = self.scorer, self.model.semantic_field
        assert scorer is not None and field_ is not None
        photo = self.datamanager.eval_dataset.photos[batch["image_idx"]]
        size = scoring_size(photo.height, photo.width)
        keep = batch["mask"][..., 0] if "mask" in batch else None
        raw = inside(scorer.field_maps(field_.decode_clip, self.model.rendered_codes, size), keep)
        evaluated.field_maps = inside(blurred(raw), keep)
        evaluated.teacher_maps = inside(blurred(scorer.teacher_maps(batch["clip_target"], size)), keep)
        scored = {"": evaluated.field_maps, "raw_": raw, "teacher_": evaluated.teacher_maps}
        for prefix, maps in scored.items():
            evaluated.metrics |= scorer.scores(photo.name, maps, prefix)

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Means over the held-out photos, for `ns-eval` and the trainer; see `average`.

        output_path: folder for a picture of every photo, if wanted.
        """
        photos = []
        for evaluated in self.evaluate():
            photos.append(evaluated.metrics)
            if output_path is not None:
                _write_pictures(evaluated, output_path)
        return average(photos, get_std)

    def get_train_loss_dict(self, step: int):
        """Outputs, losses and metrics of the next photo."""
        outputs, self.last_losses, metrics = super().get_train_loss_dict(step)
        return outputs, self.last_losses, metrics

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


def average(photos: list[dict[str, float]], with_deviation: bool = False) -> dict[str, Any]:
    """Means over photos of every figure; `map`, `raw_map` and `teacher_map`, unweighted means over the
    categories of `ap_…`, `raw_ap_…` and `teacher_ap_…`; `ap_…_photos`, how many photos that is."""
    means: dict[str, Any] = mean_over_photos(photos)
    totals = {f"{who}map": mean_average_precision(means, who) for who in ("", "raw_", "teacher_")}
    counts = {
        f"{name}_photos": sum(name in photo for photo in photos) for name in means if name.startswith("ap_")
    }
    if with_deviation:
        deviations = deviation_over_photos(photos)
        means = {
            key: v for name in means for key, v in ((name, means[name]), (f"{name}_std", deviations[name]))
        }
    means |= {name: value for name, value in totals.items() if value is not None}
    return means | counts


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
