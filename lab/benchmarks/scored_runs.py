"""Training and scoring of a row of a comparison on a scene with ground truth, with results kept on disk."""

from __future__ import annotations

import json
import math
import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from copy import deepcopy
from dataclasses import FrozenInstanceError, asdict, dataclass, replace
from functools import cached_property, partial
from itertools import islice
from multiprocessing import get_context
from multiprocessing.context import BaseContext
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float, UInt8
from torch import Tensor

from lab.benchmarks.ablation_rows import CLIPSEG, FINE_TEACHER, LANGSAM, SAM3, SEGMENTERS, Row
from lab.landmark.novel_views import read_novel_views
from lab.reports import reset_host_peak
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded, write_atomically
from lang3dxl_ns.common.reports import host_peak

if TYPE_CHECKING:
    from lang3dxl_ns.evaluation.ground_truth import GroundTruth
    from lang3dxl_ns.evaluation.scores import LanguageScorer, Maps, MapScorer
    from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline
    from lang3dxl_ns.plugin.trainer_config import Lang3DXLTrainerConfig
    from lang3dxl_ns.preparation.segmentation import TextSegmenter
    from lang3dxl_ns.preparation.targets import TargetReader
    from lang3dxl_ns.scene.photo import Photo
    from lang3dxl_ns.training.batches import TrainingData

_LIBRARIES = ("lang3dxl_ns.plugin.trainer_config", "lang3dxl_ns.methods")
"""Modules that a run's process imports. They are preloaded because the imports take ten seconds."""
_TIMED_PHOTOS = 3
_UNWANTED = ("num_rays_per_sec", "fps")
_BESIDE = ("map", "raw_map", "localization_accuracy", "cc_psnr", "clip_l1", "clip_cosine")
"""Figures kept of test views and seen photos, besides every category's average precision."""


@dataclass(frozen=True)
class RunSettings:
    """Settings shared by all runs of a comparison."""

    clip: str
    dense: str
    foreground: str
    scale: float
    flags: str
    """Extra flags of `ns-train lang3dxl`."""
    clipseg: str = ""
    """Name or folder of CLIPSeg."""
    langsam: tuple[str, str] = ("", "")
    """Names or folders of LangSAM's GroundingDINO and SAM."""
    sam3: str = ""
    """Name or folder of SAM 3."""

    def segmenter(self, row: str) -> tuple[str, str]:
        """Return the names or folders of a segmenter row's network and of its SAM ("" if it has none)."""
        return {CLIPSEG: (self.clipseg, ""), LANGSAM: self.langsam, SAM3: (self.sam3, "")}[row]


@dataclass(frozen=True)
class Run:
    """One row on one scene with one seed."""

    row: Row
    scene: Path
    label: str
    """The scene's unique label."""
    seed: int
    steps: int = 1_200
    """Training iterations."""

    @property
    def name(self) -> str:
        return f"{self.label}/{self.row.name}/{self.steps}-{self.seed}"


class ScoredRuns:
    """Runs of a comparison. Finished ones are on disk, with the settings that they were made with."""

    def __init__(self, folder: Path, settings: RunSettings) -> None:
        self.folder, self.settings = folder, settings

    @cached_property
    def _clip_weights(self) -> str:
        """Fingerprint of the CLIP's weights, so that another version under the same name is noticed."""
        from lang3dxl_ns.preparation.model_files import CLIP_OPTION, find_model

        clip = self.settings.clip
        return clip if clip == "none" else find_model(clip, CLIP_OPTION).identity

    def finished(self, run: Run) -> dict[str, float] | None:
        """Load the figures of a run made with these settings; return None if it has yet to be made."""
        path = self._path(run)
        if not path.is_file():
            return None
        found = json.loads(path.read_text())
        return found["figures"] if found["made_with"] == self._made_with(run) else None

    def make(self, run: Run) -> dict[str, float]:
        """Train and score in a separate process, so that its peak memory can be measured. Its output goes to
        a log next to the result.

        Raises UserError with the reason if the run fails.
        """
        path = self._path(run)
        path.parent.mkdir(parents=True, exist_ok=True)
        figures = self._submit(run, path.with_suffix(".log"))
        if broken := [name for name, value in figures.items() if not math.isfinite(value)]:
            raise UserError(f"not finite: {', '.join(broken)} (see {path.with_suffix('.log')})")
        result = {"made_with": self._made_with(run), "figures": figures}
        write_atomically(path, json.dumps(result, indent=1, allow_nan=False) + "\n")
        return figures

    def _submit(self, run: Run, log: Path) -> dict[str, float]:
        work = self.folder / f"work-{run.name.replace('/', '-')}"
        try:
            return in_own_process(_in_process, run, self.settings, work, log)
        finally:
            shutil.rmtree(work, ignore_errors=True)

    def _path(self, run: Run) -> Path:
        return self.folder / "results" / f"{run.name}.json"

    def _made_with(self, run: Run) -> dict[str, Any]:
        made_with = {"scene": str(run.scene), "changes": dict(run.row.changes), **asdict(self.settings)}
        made_with["clip_weights"] = self._clip_weights
        if run.row.method != "lang3dxl":
            made_with["method"] = run.row.method
        for name in set(SEGMENTERS) - {run.row.name}:
            del made_with[name]
        return json.loads(json.dumps(made_with))


def in_own_process(work: Callable[..., dict[str, float]], *args: Any) -> dict[str, float]:
    """Run `work(*args)`, whose last argument is its log, in its own process, so that its peak memory can be
    measured. Work, arguments and result must be picklable.

    Without a GPU, processes are forked from one that has imported `_LIBRARIES`. With a GPU, they are started
    anew, since a process that has used a GPU cannot be forked. Raises UserError with the reason if it fails.
    """
    if torch.cuda.is_available():
        context: BaseContext = get_context("spawn")
    else:
        context = get_context("forkserver")
        context.set_forkserver_preload(list(_LIBRARIES))
    try:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            return pool.submit(work, *args).result()
    except BrokenProcessPool as error:
        raise UserError(f"killed, most likely for lack of memory (see {args[-1]})") from error
    except (RuntimeError, MemoryError) as error:
        raise UserError(f"{error} (see {args[-1]})") from error


def scene_labels(scenes: Sequence[Path]) -> dict[str, Path]:
    """Give every scene a short unique name: its folder's, preceded by its parent's if that is taken.

    Raises UserError for a scene that is missing, has no ground truth, or is given twice.
    """
    labels: dict[str, Path] = {}
    for scene in (expanded(path).absolute() for path in scenes):
        if not (scene / "ground_truth").is_dir():
            raise UserError(
                f"{scene} has no ground_truth folder to score with: make a scene with `lang3dxl demo-scene`"
            )
        names = [scene.name, f"{scene.parent.name}-{scene.name}"]
        label = next((name for name in names if name not in labels), None)
        if scene in labels.values() or label is None:
            raise UserError(f"{scene} is given twice, or has the same name as another: rename its folder")
        labels[label] = scene
    return labels


def run_configuration(run: Run, settings: RunSettings, work: Path) -> Lang3DXLTrainerConfig:
    """Build the configuration of a run, which goes on where an earlier attempt in the folder was stopped."""
    from lab.run_config import run_config

    names = settings.clip, settings.dense, run.row.method
    config = run_config(run.scene, work / "runs", run.label, run.steps, *names)
    config.timestamp = f"{run.row.name}-{run.seed}"
    data = config.pipeline.datamanager
    data.foreground, data.camera_res_scale_factor = settings.foreground, settings.scale
    if settings.flags:
        options = tyro.conf.FlagConversionOff  # as for `ns-train`, switches take True or False
        config = tyro.cli(type(config), args=shlex.split(settings.flags), default=config, config=(options,))
        data = config.pipeline.datamanager
    if run.row.own_targets:
        # With a shared cache, rows would overwrite each other's targets. The run makes its own, and is timed.
        data.cache_dir = work / "targets"
    config.machine.seed = run.seed
    data.train_cameras_sampling_seed = run.seed
    apply_changes(config, run.row.changes)
    checkpoints = config.get_base_dir() / config.relative_model_dir
    if any(checkpoints.glob("step-*.ckpt")):
        config.load_dir = checkpoints
    config.set_timestamp()
    return config


def apply_changes(config: Any, changes: Mapping[str, Any]) -> None:
    """Set values by their dotted path. Raises AttributeError or KeyError for a path that does not exist."""
    for path, value in changes.items():
        _changed(config, path, value)


def _changed(owner: Any, path: str, value: Any) -> Any:
    """Return `owner` with a value set by its path, which is another object if `owner` is frozen."""
    name, _, rest = path.partition(".")
    held = owner[name] if isinstance(owner, dict) else getattr(owner, name)
    if (new := _changed(held, rest, value) if rest else value) is held:
        return owner
    try:
        setattr(owner, name, new)
    except FrozenInstanceError:
        return replace(owner, **{name: new})
    return owner


# ── inside the process ──────────────────────────────────────────────────────────────────────────────────


def _in_process(run: Run, settings: RunSettings, work: Path, log: Path) -> dict[str, float]:
    write_output_to(log)
    special = dict.fromkeys(SEGMENTERS, _score_segmenter) | {FINE_TEACHER: _score_fine_crops}
    return special.get(run.row.name, _train_and_score)(run, settings, work)


def write_output_to(log: Path) -> None:
    """Redirect everything that this process prints from now on to a file."""
    with open(log, "w") as file:
        sys.stdout.flush()
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)


def _train_and_score(run: Run, settings: RunSettings, work: Path) -> dict[str, float]:
    from lab.baselines.langsplat import LangSplat
    from lang3dxl_ns.evaluation.aggregate import average
    from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer

    config = run_configuration(run, settings, work)
    torch.manual_seed(run.seed)
    trainer: Lang3DXLTrainer = config.setup(local_rank=0, world_size=1)
    start, clock = _now(), time.perf_counter()
    trainer.setup()
    set_up = _now() - start
    learned = set_up * LangSplat.seconds / (time.perf_counter() - clock)
    _reset_peak()
    start = _now()
    trainer.train()
    seconds = _now() - start
    peak = _peak()
    figures = average([photo.metrics for photo in trainer.pipeline.evaluation.evaluate("held-out")])
    figures = {name: value for name, value in figures.items() if name not in _UNWANTED}
    figures |= _beside(trainer.pipeline)
    return figures | {
        "setup_seconds": set_up - learned,
        "train_seconds": learned + seconds,
        "train_peak_mb": peak / 2**20,
        "gaussians": trainer.pipeline.model.num_points,
        **_time_answers(trainer.pipeline),
    }


def _beside(pipeline: Lang3DXLPipeline) -> dict[str, float]:
    """Compute the figures of test views (`test_…`) and of labeled training photos (`seen_…`), if there are
    any. Both are far more numerous than the held-out photos."""
    from lab.landmark.novel_views_of_runs import evaluate_novel_views
    from lang3dxl_ns.evaluation.aggregate import PREFIXES, average

    scorer, data = pipeline.evaluation.scorer, pipeline.datamanager.data
    names, splits = data.capture.split.train, {}
    if read_novel_views(data.capture.folder) is not None:
        splits["test"] = evaluate_novel_views(pipeline.model.run, data)
    if scorer is not None and any(scorer.truth.key(name) is not None for name in names):
        splits["seen"] = pipeline.evaluation.evaluate("seen")
    found = {}
    for split, evaluated in splits.items():
        for name, value in average([photo.metrics for photo in evaluated]).items():
            plain = next((name.removeprefix(p) for p in PREFIXES if p and name.startswith(p)), name)
            if plain in _BESIDE or plain.startswith("ap_"):
                found[f"{split}_{name}"] = value
    return found


def _reset_peak() -> None:
    reset_host_peak()
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()


def _peak() -> float:
    """Return the peak memory in bytes: of the GPU if there is one, else of the process with libraries."""
    return torch.cuda.max_memory_allocated() if torch.cuda.is_available() else host_peak()


@torch.no_grad()
def _time_answers(pipeline: Lang3DXLPipeline) -> dict[str, float]:
    """Measure the median milliseconds to render a held-out view, and to answer all prompts in it."""
    from lang3dxl_ns.plugin.cameras import photo_camera
    from lang3dxl_ns.query.answer import relevancy_maps
    from lang3dxl_ns.training.snapshot import snapshot

    scorer = pipeline.evaluation.scorer
    if scorer is None:
        return {}
    pipeline.eval()
    times: dict[str, list[float]] = {"render_ms": [], "answer_ms": []}
    scene = snapshot(pipeline.model.run, pipeline.scene_file, encode_texts=scorer.encode_texts)
    for camera, _ in islice(pipeline.datamanager.fixed_indices_eval_dataloader, _TIMED_PHOTOS):
        start = _now()
        pipeline.model.get_outputs_for_camera(camera)
        rendered = _now()
        relevancy_maps(scene, photo_camera(camera).camera(), scorer.queries.to(pipeline.device))
        times["render_ms"].append(1000 * (rendered - start))
        times["answer_ms"].append(1000 * (_now() - rendered))
    return {name: median(values) for name, values in times.items()}


def _now() -> float:
    """Return the time in seconds: wall-clock with a GPU, otherwise processor time (all threads), which
    excludes other programs and concurrent runs."""
    if not torch.cuda.is_available():
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def _score_segmenter(run: Run, settings: RunSettings, work: Path) -> dict[str, float]:
    """Score a segmenter on the scored pictures themselves, by the same rules as trained rows."""
    from lang3dxl_ns.evaluation.scores import MapScorer
    from lang3dxl_ns.preparation.segmentation import find_text_segmenter, load_text_segmenter

    segmenter = load_text_segmenter(find_text_segmenter(*settings.segmenter(run.row.name)), "cpu")
    found: dict[str, float] = {}
    for prefix, truth, photos in _pictures(run, _colors_alone(run_configuration(run, settings, work))):
        maps = partial(_segmenter_maps, segmenter, truth.categories)
        found |= _score_pictures(prefix, MapScorer(truth), photos, maps)
    return found


def _segmenter_maps(
    segmenter: TextSegmenter, words: Sequence[str], photo: Photo, size: tuple[int, int]
) -> Maps:
    from lang3dxl_ns.evaluation.scores import resize_map

    found = resize_map(probabilities(segmenter, photo.read_uint8(), words), size)
    return dict(zip(words, found, strict=True))


@torch.no_grad()
def probabilities(
    segmenter: Any, image: UInt8[Tensor, "h w 3"], prompts: Sequence[str]
) -> Float[Tensor, "q h w"]:
    """Compute a segmenter's confidence in every prompt at every pixel, 0…1, at the image's size, on the CPU:
    of a SAM 3, the highest instance score × mask, without a threshold; of boxes with a SAM, the score of the
    best box whose mask covers the pixel, else 0."""
    from lang3dxl_ns.preparation.segmentation import BoxesAndSam, ClipSeg

    if isinstance(segmenter, ClipSeg):
        return segmenter.probabilities(image, prompts)
    maps = []
    if isinstance(segmenter, BoxesAndSam):
        for prompt in prompts:
            boxes, scores = segmenter.boxes(image, prompt)
            nowhere = torch.zeros(1, *image.shape[:2])
            scored = scores[:, None, None] * segmenter.masks(image, boxes)
            maps.append(torch.cat([nowhere, scored]).amax(dim=0))
        return torch.stack(maps)
    for output in segmenter.outputs(image, prompts):
        scores = (output.pred_logits.sigmoid() * output.presence_logits.sigmoid())[0]
        maps.append((scores[:, None, None] * output.pred_masks[0].sigmoid()).amax(dim=0))
    size = tuple(image.shape[:2])
    return F.interpolate(torch.stack(maps)[None].float(), size, mode="bilinear")[0].cpu()


def _score_fine_crops(run: Run, settings: RunSettings, work: Path) -> dict[str, float]:
    """Score the pictures' own fine targets, made in the way that training photos' targets are."""
    from lab.landmark.novel_views_of_runs import novel_pixel_sizes
    from lang3dxl_ns.evaluation.scores import open_scorer
    from lang3dxl_ns.preparation.prepare import prepare
    from lang3dxl_ns.preparation.store import FeatureStore

    whole = run_configuration(run, settings, work)
    data, config = _colors_alone(deepcopy(whole)), whole.pipeline.datamanager
    config.dense = "none"
    found: dict[str, float] = {}
    plan, store = data.crops, FeatureStore(work / "targets")
    for prefix, truth, photos in _pictures(run, data):
        views = read_novel_views(data.capture.folder) if prefix else None
        sizes = plan.pixel_sizes if views is None else novel_pixel_sizes(data, views, photos)
        names = [photo.name for photo in photos]
        targets = prepare(photos, sizes, config, plan.scales, store, "cpu", fine=names)
        scorer = open_scorer(truth, config.clip, "cpu")
        maps = partial(_crop_maps, scorer, targets)
        found |= _score_pictures(prefix, scorer, photos, maps)
    return found


def _crop_maps(scorer: LanguageScorer, targets: TargetReader, photo: Photo, size: tuple[int, int]) -> Maps:
    return scorer.teacher_maps(targets.clip(photo.name).features.float(), size)


def _colors_alone(config: Lang3DXLTrainerConfig) -> TrainingData:
    """Open the data of a configuration without encoders, so that it makes no targets."""
    data = config.pipeline.datamanager
    data.clip = data.dense = "none"
    return data.setup(device="cpu", test_mode="test").data


def _pictures(run: Run, data: TrainingData) -> Iterator[tuple[str, GroundTruth, list[Photo]]]:
    """Yield held-out photos and test views, each with the prefix of their figures and their truth."""
    from lab.landmark.novel_views_of_runs import novel_data
    from lang3dxl_ns.evaluation.ground_truth import GroundTruth

    yield "", GroundTruth(run.scene / "ground_truth"), [data.photos[n] for n in data.capture.split.held_out]
    if (views := read_novel_views(data.capture.folder)) is not None:
        yield "test_", views.truth, novel_data(data, views).as_read


def _score_pictures(
    prefix: str, scorer: MapScorer, photos: Sequence[Photo], maps_of: Callable[[Photo, tuple[int, int]], Maps]
) -> dict[str, float]:
    """Compute the mean figures of photos. `maps_of` makes a photo's maps at a given size."""
    from lang3dxl_ns.evaluation.aggregate import average

    scored = []
    for photo in photos:
        maps = maps_of(photo, scorer.truth.scoring_size(photo.height, photo.width))
        scored.append(scorer.scores(photo.name, scorer.variants(maps)))
    return {f"{prefix}{name}": value for name, value in average(scored).items()}
