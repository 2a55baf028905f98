"""`lang3dxl benchmark training`: cost and quality of semantics, by training with and without them."""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

from lab.reports import command_line, timing
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report
from lang3dxl_ns.common.settings_help import showing

PARTS = ("data", "render", "appearance", "decode", "downsample", "losses", "backward", "optimizer")
"""Parts of a step; appearance is within the rendering."""


@showing("data", "out")
@dataclass
class TrainingBenchmark:
    """Train with and without semantics, evaluate on held-out photos, and time every part of a step."""

    data: Path
    """Folder with images/ and sparse/0/."""
    out: Path
    """Folder for training.md, training.json and the two runs."""
    clip: str = "openai/clip-vit-base-patch32"
    """CLIP: a Hugging Face name or directory."""
    dense: str = "facebook/dinov2-small"
    """Dense encoder: a Hugging Face name or directory, or none."""
    iterations: int = 1_000
    """Iterations of each run."""
    scale: float = 0.25
    """Size of the training photos relative to those on disk."""
    threads: tuple[int, ...] = ()
    """Numbers of threads, such as 1 2 4 8, to train the colors with as well, for a table of their steps."""

    def main(self) -> None:
        """Runs each variant in its own process, so that its peak memory can be measured. They run one after
        the other, so on a busy machine quote the split of a step and ratios, not absolute seconds."""
        results = {}
        colors = replace(self, clip="none", dense="none")
        runs = {"joint": (self, 0), "rgb only": (colors, 0)}
        runs |= {f"{count} threads": (colors, count) for count in self.threads}
        for name, run in runs.items():
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                results[name] = pool.submit(_train_and_evaluate, *run).result()
        write_report(self.out, "training", markdown(self, results), results)
        print(f"Wrote {self.out / 'training.md'}")


def _train_and_evaluate(settings: TrainingBenchmark, threads: int = 0) -> dict[str, Any]:
    import resource

    import torch

    from lab.run_config import run_config
    from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer

    name = "joint" if settings.clip != "none" else "rgb"
    if threads:
        torch.set_num_threads(threads)
    runs = settings.out / (f"runs-{threads}" if threads else "runs")
    config = run_config(settings.data, runs, name, settings.iterations, settings.clip, settings.dense)
    config.pipeline.datamanager.camera_res_scale_factor = settings.scale
    config.set_timestamp()
    config.save_config()
    torch.manual_seed(config.machine.seed)
    trainer: Lang3DXLTrainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    iterate, spent = trainer.train_iteration, Counter[str]()

    def iterate_by_parts(step: int) -> Any:
        with timing(_parts(trainer)) as found:
            result = iterate(step)
        spent.update({name: sum(seconds) for name, seconds in found.items()})
        return result

    trainer.train_iteration = iterate_by_parts  # type: ignore[method-assign]
    start = time.perf_counter()
    with timing({"step": [(trainer, "train_iteration")]}) as seconds:
        trainer.train()
    total = time.perf_counter() - start
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    step = median(seconds["step"])
    split = {name: spent[name] / len(seconds["step"]) for name in PARTS if name in spent}
    cuda = torch.cuda.is_available()
    return {
        "metrics": metrics,
        "seconds_per_step": step,
        "split_seconds": split,
        "training_seconds": total,
        "peak_memory_mb": torch.cuda.max_memory_allocated() / 2**20
        if cuda
        else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "gaussians": trainer.pipeline.model.num_points,
        "machine": describe_machine(trainer.device),
    }


def _parts(trainer: Any) -> dict[str, list[tuple[Any, str]]]:
    """Return the functions of each part of a step."""
    from torch import Tensor

    from lang3dxl_ns.components import losses
    from lang3dxl_ns.components.appearance import AppearanceField
    from lang3dxl_ns.components.downsampler import AttenuatedDownsampler
    from lang3dxl_ns.components.semantic_field import SemanticField
    from lang3dxl_ns.plugin import model
    from lang3dxl_ns.training.batches import TrainingData

    compared = ("rgb_loss", "clip_loss", "dense_loss", "region_variance_loss")
    return {
        "data": [(TrainingData, "next")],
        "render": [(model, "render")],
        "appearance": [(AppearanceField, "forward")],
        "decode": [(SemanticField, "forward")],
        "downsample": [(AttenuatedDownsampler, "match")],
        "losses": [(losses, name) for name in compared],
        "backward": [(Tensor, "backward")],
        "optimizer": [(trainer.optimizers, "optimizer_scaler_step_some")],
    }


def markdown(settings: TrainingBenchmark, results: dict[str, dict]) -> str:
    """The report of all runs, in markdown."""
    runs, machine = results.values(), results["joint"]["machine"]
    names = [n for n in results["joint"]["metrics"] if n not in ("num_rays_per_sec", "fps")]
    quality = [[name, *(_figure(run["metrics"].get(name)) for run in runs)] for name in names]
    cost = [
        *([f"{p} (ms)", *(_milliseconds(run["split_seconds"].get(p)) for run in runs)] for p in PARTS),
        ["median step (ms)", *(_milliseconds(run["seconds_per_step"]) for run in runs)],
        ["whole training (s)", *(_figure(run["training_seconds"]) for run in runs)],
        ["peak memory (MB)", *(_figure(run["peak_memory_mb"]) for run in runs)],
        ["Gaussians at the end", *(run["gaussians"] for run in runs)],
    ]
    return f"""# Training on `{settings.data.name}`: with and without semantics

    {command_line("lang3dxl benchmark training", settings)}

{settings.iterations} iterations, photos at {settings.scale} of their size. {machine}

## Quality

{markdown_table(["held-out photos", *results], quality)}

`*_of_mean` is the same figure for predicting the mean feature of the training photos everywhere.

## Cost of a step

Mean milliseconds by part, with appearance inside `render`; and the median step.

{markdown_table(["", *results], cost)}
"""


def _milliseconds(seconds: float | None) -> str | None:
    return None if seconds is None else _figure(1000 * seconds)


def _figure(value: float | None) -> str | None:
    return None if value is None else f"{value:.4g}"
