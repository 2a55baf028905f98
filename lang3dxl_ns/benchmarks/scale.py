"""`lang3dxl benchmark scale`: growth of memory and time with photos and Gaussians, on generated scenes."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from lang3dxl_ns.common.reports import (
    command_line,
    describe_machine,
    host_peak,
    in_own_process,
    markdown_table,
    write_report,
)

if TYPE_CHECKING:
    from lang3dxl_ns.plugin.trainer_config import Lang3DXLTrainerConfig

_alone = partial(in_own_process, preload=("lang3dxl_ns.methods", "pycolmap", "transformers"))

PREDICTION = """Written before measuring. *Photos*: preparation holds one photo, one batch of crops and the
encoders: constant. Training holds the cache (here `cache_gb`), the photos read ahead, the Gaussians and one
step: it grows until the cache is full and is constant afterwards, except for the model's tracks (about 100
bytes per observation) and a few kilobytes of bookkeeping per photo, 20 MB from 200 to 2,000 photos. The time
of a step does not depend on the number of photos; out of core it may take 10 % longer, since another thread
decodes photos meanwhile. *Gaussians*: 62 numbers each (59 of 3D Gaussian splatting and a code of 3), with
gradients and Adam's two moments, are 1 kB each; a step's memory grows linearly on top of a constant for the
decoder's maps, its time linearly or less."""


@dataclass
class ScaleBenchmark:
    """Prepare, train and evaluate generated scenes with growing numbers of photos and Gaussians."""

    out: Path
    """Folder for scale.md, scale.json and the scenes (deleted afterwards)."""
    photos: tuple[int, ...] = (200, 500, 1000, 2000)
    """Numbers of photos."""
    gaussians: tuple[int, ...] = (10_000, 50_000, 100_000, 400_000)
    """Numbers of Gaussians, with few photos."""
    steps: int = 200
    """Training steps of each run with photos."""
    gaussian_steps: int = 5
    """Training steps of each run with Gaussians."""
    pairs: int = 3
    """Runs with the fewest photos, alternately out of core and in memory, to compare their steps."""
    workers: tuple[int, ...] = (1, 2)
    """Numbers of processes to prepare the fewest photos with."""
    cache_gb: float = 0.01
    """Memory for photos and targets: small, so that even the fewest photos fill it."""
    encoders: str = "builtin"
    """CLIP and dense encoder; none measures photos alone."""

    def main(self) -> None:
        """Runs each measurement in its own process, so that its peak memory can be measured."""
        rows: dict[str, list[dict[str, Any]]] = {"photos": [], "pairs": [], "workers": [], "gaussians": []}
        for count in sorted(self.photos):
            scene = _Measured(
                self.out / f"photos-{count}", count, 2_000, self.steps, self.cache_gb, self.encoders
            )
            rows["photos"].append(_alone(_measure, scene))
            if count == min(self.photos):
                self._measure_variants(scene, rows)
            shutil.rmtree(scene.folder)
            self._write(rows)
        for count in self.gaussians:
            scene = _Measured(
                self.out / f"gaussians-{count}", 20, count, self.gaussian_steps, self.cache_gb, self.encoders
            )
            rows["gaussians"].append(_alone(_measure, scene))
            shutil.rmtree(scene.folder)
            self._write(rows)
        print(f"Wrote {self.out / 'scale.md'}")

    def _measure_variants(self, scene: _Measured, rows: dict[str, list[dict[str, Any]]]) -> None:
        for _ in range(self.pairs):
            pair = {
                "out of core": _alone(_measure, scene),
                "in memory": _alone(_measure, replace(scene, cache_gb=1e3)),
            }
            rows["pairs"].append(pair)
        for workers in self.workers if self.encoders != "none" else ():
            seconds = _alone(_prepare, replace(scene, workers=workers))
            rows["workers"].append(
                {"workers": workers, "seconds": seconds, "photos_per_second": scene.photos / seconds}
            )

    def _write(self, rows: dict[str, list[dict[str, Any]]]) -> None:
        write_report(self.out, "scale", markdown(self, rows), rows)


@dataclass(frozen=True)
class _Measured:
    folder: Path
    photos: int
    points: int
    steps: int
    cache_gb: float
    encoders: str
    workers: int = 1


def _measure(scene: _Measured) -> dict[str, Any]:
    """Seconds and peak memory (bytes beyond the process with everything imported) of each part."""
    from lang3dxl_ns.common import timing
    from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer

    config = _configuration(scene)
    config.save_config()
    empty = host_peak(reset=True)
    start = time.perf_counter()
    trainer: Lang3DXLTrainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    prepared, after_preparation = time.perf_counter() - start, host_peak(reset=True)
    times: list[float] = []
    iterate = trainer.train_iteration

    def timed(step: int):
        begin = time.process_time()  # of all threads; excludes other processes
        result = iterate(step)
        times.append(time.process_time() - begin)
        return result

    trainer.train_iteration = timed  # type: ignore[method-assign]
    with timing.measure() as seconds:
        trainer.train()
    after_training = host_peak(reset=True)
    trainer.pipeline.get_average_eval_image_metrics()
    store = trainer.pipeline.datamanager.cache_dir
    return {
        "photos": scene.photos,
        "gaussians": trainer.pipeline.model.num_points,
        "preparation_s": prepared,
        "preparation_bytes": after_preparation - empty,
        "training_bytes": after_training - empty,
        "evaluation_bytes": host_peak() - empty,
        "step_s": median(times[len(times) // 5 :]),  # without the first steps, which warm up caches
        "data_s": median(seconds["data"]),
        "store_bytes": sum(path.stat().st_size for path in store.rglob("*") if path.is_file()),
    }


def _prepare(scene: _Measured) -> float:
    """Seconds to prepare all photos anew, including the start of the processes."""
    data = _configuration(scene).pipeline.datamanager
    data.cache_dir = scene.folder / f"targets-{scene.workers}"
    start = time.perf_counter()
    assert data.setup(device="cpu", test_mode="val").targets is not None
    return time.perf_counter() - start


def _configuration(scene: _Measured) -> Lang3DXLTrainerConfig:
    from lang3dxl_ns.demo.landmark.crowd import write_crowd
    from lang3dxl_ns.methods import run_config

    data = scene.folder / "scene"
    if not data.exists():
        write_crowd(data, scene.photos, scene.points)
    config = run_config(data, scene.folder / "runs", "scale", scene.steps, scene.encoders, scene.encoders)
    config.pipeline.datamanager.cache_gb = scene.cache_gb
    config.pipeline.datamanager.workers = scene.workers
    config.pipeline.datamanager.scale_mode = "relative"
    config.pipeline.datamanager.scale_range = (0.4, 0.4)
    config.pipeline.datamanager.dense_tokens = 16
    config.pipeline.model.sky_gaussians = 0
    config.set_timestamp()
    return config


def markdown(settings: ScaleBenchmark, rows: dict[str, list[dict[str, Any]]]) -> str:
    """The report in markdown."""
    photos = [(r, f"{r['photos']:,}") for r in rows["photos"]]
    photos += [(r, f"{r['photos']:,}, {name}") for pair in rows["pairs"] for name, r in pair.items()]
    return f"""# Memory and time as scenes grow

    {command_line("lang3dxl benchmark scale", settings)}

{describe_machine()}

{PREDICTION}

Memory is the peak resident set beyond the process with everything imported. Photos are of 120×160 to 240×160
pixels, encoders: {settings.encoders}.

## With the number of photos

{settings.steps} steps, 2,000 Gaussians, {settings.cache_gb} GB for photos and targets.

{markdown_table(["photos", *_HEADER], [[name, *_row(r)] for r, name in photos])}

{_comparison(rows["pairs"])}{_workers(rows["workers"])}
## With the number of Gaussians

20 photos, {settings.gaussian_steps} steps.

{markdown_table(["Gaussians", *_HEADER], [[f"{r['gaussians']:,}", *_row(r)] for r in rows["gaussians"]])}
"""


def _comparison(pairs: list[dict[str, Any]]) -> str:
    ratios = sorted(pair["out of core"]["step_s"] / pair["in memory"]["step_s"] for pair in pairs)
    if not ratios:
        return ""
    return (
        f"A step out of core takes {median(ratios):.3f} of the time of one in memory (median of "
        f"{len(ratios)} pairs, {ratios[0]:.3f} to {ratios[-1]:.3f}).\n"
    )


def _workers(rows: list[dict[str, Any]]) -> str:
    if not rows:
        return ""
    lines = [[str(r["workers"]), f"{r['seconds']:.0f}", f"{r['photos_per_second']:.1f}"] for r in rows]
    table = markdown_table(["processes", "seconds", "photos per second"], lines)
    return f"\n## With the number of processes that prepare\n\n{table}\n"


_HEADER = [
    "preparation (s)",
    "its memory (MB)",
    "training's memory (MB)",
    "evaluation's memory (MB)",
    "median step (ms of CPU)",
    "of it waiting for data (ms)",
    "store (MB)",
]


def _row(r: dict[str, Any]) -> list[str]:
    sizes = [f"{r[f'{part}_bytes'] / 1e6:.0f}" for part in ("preparation", "training", "evaluation")]
    step = [f"{1e3 * r['step_s']:.0f}", f"{1e3 * r['data_s']:.1f}", f"{r['store_bytes'] / 1e6:.0f}"]
    return [f"{r['preparation_s']:.0f}", *sizes, *step]
