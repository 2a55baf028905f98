"""Trains a variant of the method on a scene with ground truth, scores it, and never does so twice."""

from __future__ import annotations

import json
import math
import os
import shlex
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import torch

from lang3dxl_ns.baselines.rows import CLIPSEG, Row
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.report import host_peak, in_own_process, write_atomically

if TYPE_CHECKING:
    from lang3dxl_ns.evaluation.scores import MapScorer
    from lang3dxl_ns.pipeline import Lang3DXLPipeline
    from lang3dxl_ns.trainer import Lang3DXLTrainerConfig

_LIBRARIES = ("lang3dxl_ns.trainer", "lang3dxl_ns.methods")
"""What a run's process needs: ten seconds of loading."""
_TIMED_PHOTOS = 3
_UNWANTED = ("num_rays_per_sec", "fps")
_SEEN = ("map", "raw_map", "localisation_accuracy")
"""Figures of the photos that training saw."""


@dataclass(frozen=True)
class RunSettings:
    """What all runs of a comparison have in common."""

    steps: int
    clip: str
    dense: str
    foreground: str
    scale: float
    dense_tokens: int
    flags: str
    """More flags of `ns-train lang3dxl`."""
    clipseg: str
    """Name or folder of the CLIPSeg."""


@dataclass(frozen=True)
class Run:
    """One row on one scene with one seed."""

    row: Row
    scene: Path
    label: str
    """The scene's, unique."""
    seed: int

    @property
    def name(self) -> str:
        return f"{self.label}/{self.row.name}/{self.seed}"


class ScoredRuns:
    """Runs of a comparison; those that are finished are on disk, with the settings that made them."""

    def __init__(self, folder: Path, settings: RunSettings) -> None:
        self.folder, self.settings = folder, settings

    def finished(self, run: Run) -> dict[str, float] | None:
        """Figures of a run that was made with these settings; None where it has to be made."""
        path = self._path(run)
        if not path.is_file():
            return None
        found = json.loads(path.read_text())
        return found["figures"] if found["made_with"] == self._made_with(run) else None

    def make(self, run: Run) -> dict[str, float]:
        """Train and score in a process of its own, so that its peak memory is its own; what it prints goes to
        a log beside the result.

        Raises UserError when the run fails, with the reason.
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
        work = self.folder / f"work-{run.label}-{run.row.name}-{run.seed}"
        try:
            return in_own_process(_in_process, run, self.settings, work, log, preload=_LIBRARIES)
        except BrokenProcessPool as error:
            raise UserError(f"killed, most likely for want of memory (see {log})") from error
        except (RuntimeError, MemoryError) as error:
            raise UserError(f"{error} (see {log})") from error
        finally:
            shutil.rmtree(work, ignore_errors=True)

    def _path(self, run: Run) -> Path:
        return self.folder / "results" / run.label / run.row.name / f"seed{run.seed}.json"

    def _made_with(self, run: Run) -> dict[str, Any]:
        made_with = {"scene": str(run.scene), "changes": dict(run.row.changes), **asdict(self.settings)}
        if run.row.name != CLIPSEG:
            del made_with["clipseg"]
        return json.loads(json.dumps(made_with))


def scene_labels(scenes: Sequence[Path]) -> dict[str, Path]:
    """A short unique name per scene: what its folder is called, the folder above where two agree.

    Raises UserError for a scene that is missing, has no ground truth, or is given twice.
    """
    labels: dict[str, Path] = {}
    for scene in (path.expanduser().absolute() for path in scenes):
        if not (scene / "ground_truth").is_dir():
            raise UserError(
                f"{scene} has no ground_truth folder to score with: make a scene with `lang3dxl demo-scene`"
            )
        names = [scene.name, f"{scene.parent.name}-{scene.name}"]
        label = next((name for name in names if name not in labels), None)
        if scene in labels.values() or label is None:
            raise UserError(f"{scene} is given twice, or can't be told from another: rename its folder")
        labels[label] = scene
    return labels


def run_configuration(run: Run, settings: RunSettings, work: Path) -> Lang3DXLTrainerConfig:
    """The configuration of a run."""
    import tyro

    from lang3dxl_ns.methods import run_config

    config = run_config(run.scene, work / "runs", run.label, settings.steps, settings.clip, settings.dense)
    config.timestamp = f"{run.row.name}-{run.seed}"
    data = config.pipeline.datamanager
    data.foreground, data.camera_res_scale_factor = settings.foreground, settings.scale
    data.dense_tokens = settings.dense_tokens
    if settings.flags:
        config = tyro.cli(type(config), args=shlex.split(settings.flags), default=config)
        data = config.pipeline.datamanager
    if run.row.own_targets:
        # Else rows would overwrite each other's targets. Made anew in every run, and timed.
        data.cache_dir = work / "targets"
    config.machine.seed = run.seed
    data.train_cameras_sampling_seed = run.seed
    apply_changes(config, run.row.changes)
    config.set_timestamp()
    return config


def apply_changes(config: Any, changes: Mapping[str, Any]) -> None:
    """Set values by their dotted path. Raises AttributeError or KeyError for a path that doesn't exist."""
    for path, value in changes.items():
        *owners, name = path.split(".")
        owner = config
        for part in owners:
            owner = owner[part] if isinstance(owner, dict) else getattr(owner, part)
        getattr(owner, name)
        setattr(owner, name, value)


# ── inside the process ──────────────────────────────────────────────────────────────────────────────────


def _in_process(run: Run, settings: RunSettings, work: Path, log: Path) -> dict[str, float]:
    with open(log, "w") as file:
        sys.stdout.flush()
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    work_on = _score_clipseg if run.row.name == CLIPSEG else _train_and_score
    return work_on(run, settings, work)


def _train_and_score(run: Run, settings: RunSettings, work: Path) -> dict[str, float]:
    from lang3dxl_ns import timing
    from lang3dxl_ns.evaluation.aggregate import average
    from lang3dxl_ns.trainer import Lang3DXLTrainer

    config = run_configuration(run, settings, work)
    torch.manual_seed(run.seed)
    trainer: Lang3DXLTrainer = config.setup(local_rank=0, world_size=1)
    start, clock = _now(), time.perf_counter()
    with timing.measure() as parts:
        trainer.setup()
    set_up = _now() - start
    learned = set_up * sum(parts.get("learn targets", ())) / (time.perf_counter() - clock)
    _reset_peak()
    start = _now()
    trainer.train()
    if trainer.interrupted:  # it ends in good order, but what it has learned is no result
        raise KeyboardInterrupt
    seconds = _now() - start
    peak = _peak()
    figures = average([photo.metrics for photo in trainer.pipeline.evaluate()])
    figures = {name: value for name, value in figures.items() if name not in _UNWANTED}
    figures |= _seen_in_training(trainer.pipeline)
    return figures | {
        "setup_seconds": set_up - learned,
        "train_seconds": learned + seconds,
        "train_peak_mb": peak / 2**20,
        "gaussians": trainer.pipeline.model.num_points,
        **_time_answers(trainer.pipeline),
    }


def _seen_in_training(pipeline: Lang3DXLPipeline) -> dict[str, float]:
    """mAP and localisation in the photos that training saw, as the paper's main table has them; they are many
    more than those held out. `teacher_` stays in front, where a row of the teacher looks for its figures."""
    from lang3dxl_ns.evaluation.aggregate import average

    scorer, photos = pipeline.scorer, pipeline.datamanager.train_dataset.photos
    if scorer is None or all(scorer.truth.key(photo.name) is None for photo in photos):
        return {}
    pipeline.config.evaluated_photos = "seen"
    figures = average([photo.metrics for photo in pipeline.evaluate()])
    return {
        f"{teacher}seen_{name}": figures[teacher + name]
        for teacher in ("", "teacher_")
        for name in _SEEN
        if teacher + name in figures
    }


def _reset_peak() -> None:
    host_peak(reset=True)
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()


def _peak() -> float:
    """Of the GPU where there is one, else of the process, the libraries included."""
    return torch.cuda.max_memory_allocated() if torch.cuda.is_available() else host_peak()


@torch.no_grad()
def _time_answers(pipeline: Lang3DXLPipeline) -> dict[str, float]:
    """Median milliseconds to render a held-out view, and to answer all prompts in it by decoding."""
    scorer, encoder = pipeline.scorer, pipeline.model.semantic_field
    if scorer is None or encoder is None:
        return {}
    pipeline.eval()
    times: dict[str, list[float]] = {"render_ms": [], "answer_ms": []}
    for camera, _ in islice(pipeline.datamanager.fixed_indices_eval_dataloader, _TIMED_PHOTOS):
        start = _now()
        pipeline.model.get_outputs_for_camera(camera)
        rendered = _now()
        codes = pipeline.model.rendered_codes
        scorer.field_maps(encoder.decode_clip, codes, (codes.shape[0], codes.shape[1]))
        times["render_ms"].append(1000 * (rendered - start))
        times["answer_ms"].append(1000 * (_now() - rendered))
    return {name: median(values) for name, values in times.items()}


def _now() -> float:
    """Seconds: of the clock with a GPU, of the processor (all threads) without one, where other programs, or
    other runs at a time, would be counted in by the clock."""
    if not torch.cuda.is_available():
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def _score_clipseg(run: Run, settings: RunSettings, work: Path) -> dict[str, float]:
    """AP of CLIPSeg in the held-out photos themselves, by the same rules."""
    from lang3dxl_ns.evaluation.aggregate import average
    from lang3dxl_ns.evaluation.ground_truth import GroundTruth
    from lang3dxl_ns.evaluation.scores import MapScorer
    from lang3dxl_ns.preparation.segmentation import ClipSeg, find_text_segmenter

    segmenter = ClipSeg(find_text_segmenter(settings.clipseg, sam="").words, "cpu")
    config = run_configuration(run, settings, work)
    config.pipeline.datamanager.clip = config.pipeline.datamanager.dense = "none"
    datamanager = config.pipeline.datamanager.setup(device="cpu", test_mode="test")
    scorer = MapScorer(GroundTruth(run.scene / "ground_truth"))
    categories, photos = scorer.truth.categories, []
    for photo in datamanager.eval_dataset.photos:
        maps = dict(zip(categories, segmenter.probabilities(photo.read_uint8(), categories), strict=True))
        photos.append(score_photo(maps, scorer, photo.name, (photo.height, photo.width)))
    return average(photos)


def score_photo(
    maps: dict[str, Any], scorer: MapScorer, name: str, size: tuple[int, int]
) -> dict[str, float]:
    """Figures of maps of a whole photo by category."""
    from lang3dxl_ns.evaluation.scores import resize_map

    small = scorer.truth.scoring_size(*size)
    resized = {category: resize_map(scores[None], small)[0] for category, scores in maps.items()}
    figures: dict[str, float] = {}
    for prefix, variant in scorer.variants(resized).items():
        figures |= scorer.scores(name, variant, prefix)
    return figures
