"""`lang3dxl benchmark scale`: seconds and memory of every stage, with a phone's photos and many Gaussians."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Literal

from lab.reports import command_line, in_own_process, reset_host_peak
from lang3dxl_ns.common.reports import describe_machine, host_peak, markdown_table, write_report
from lang3dxl_ns.common.settings_help import showing

if TYPE_CHECKING:
    from torch import Tensor

    from lang3dxl_ns.plugin.trainer_config import Lang3DXLTrainerConfig
    from lang3dxl_ns.scene.photo import Photo

_ZOOM = 20
"""Makes photos of 7.7 to 15.4 megapixels, 11 on average."""
_STEP_S = 0.015
"""A training step on a GPU, which reading ahead must keep up with."""
_STARTED = 2_000
"""Photos of the start that is timed."""
_LANDMARK_STEPS = 200
"""Training of the landmark whose features are compressed."""
_NOISE = 0.15
"""Noise of its repeated features, in their deviations."""
_VISION: dict[str, dict[str, int]] = {
    "B/32": {"patch_size": 32},
    "B/16": {"patch_size": 16},
    "L/14": {
        "patch_size": 14,
        "hidden_size": 1024,
        "intermediate_size": 4096,
        "num_hidden_layers": 24,
        "num_attention_heads": 16,
    },
}
"""CLIP's image towers, as far as they differ from transformers' default."""
Part = Literal["photos", "start", "crops", "compression", "run"]
_alone = partial(in_own_process, preload=("lang3dxl_ns.methods", "pycolmap", "transformers"))


@dataclass(frozen=True)
class Stage:
    """A measured stage."""

    name: str
    amount: str
    """What it was done for."""
    seconds: float
    cpu: float
    """Processor seconds, of all threads: reliable also where other programs run."""
    each: str
    """Processor seconds or rate of one item, in words."""
    bytes: int
    """Peak memory beyond that of the process with everything imported."""


@showing("out", "parts")
@dataclass
class ScaleBenchmark:
    """Reading, preparation and training of photos of some 11 megapixels, and compression, stage by stage."""

    out: Path
    """Folder for scale.md, scale.json and the scenes (kept, and used again)."""
    parts: tuple[Part, ...] = ("photos", "start", "crops", "compression", "run")
    """What is measured: reading; a start with everything prepared; encoding of crops; compression of a
    landmark's features, repeated with noise; whole runs."""
    photos: int = 24
    """Photos made."""
    gaussians: tuple[int, ...] = (20_000, 300_000, 1_000_000)
    """Numbers of Gaussians, compressed and of a run each."""
    clips: tuple[str, ...] = ("builtin", "B/32", "B/16", "L/14")
    """CLIPs whose crops are timed: the built-in one, and CLIP's sizes with random weights."""
    steps: int = 5
    """Training steps of a run."""

    def main(self) -> None:
        """Measures each stage in its own process, for its peak memory; writes after each."""
        stages: list[Stage] = []
        work: dict[Part, list[Callable[[], list[Stage]]]] = {
            "photos": [partial(_alone, _reading, self.out, self.photos)],
            "start": [partial(_alone, _start, self.out)],
            "crops": [partial(_alone, _crops, clip) for clip in self.clips],
            "compression": [partial(_alone, _compression, self.out, n) for n in self.gaussians],
            "run": [partial(_alone, _run, self.out, self.photos, n, self.steps) for n in self.gaussians],
        }
        for part in self.parts:
            for measure in work[part]:
                stages += measure()
                write_report(self.out, "scale", markdown(self, stages), {"stages": [vars(s) for s in stages]})
        print(f"Wrote {self.out / 'scale.md'}")


def markdown(settings: ScaleBenchmark, stages: Sequence[Stage]) -> str:
    """The report in markdown."""
    rows = [
        [s.name, s.amount, f"{s.seconds:.1f}", f"{s.cpu:.1f}", s.each, f"{s.bytes / 1e9:.2f}"] for s in stages
    ]
    return f"""# Memory and time at real size

    {command_line("lang3dxl benchmark scale", settings)}

{describe_machine()}

{markdown_table(["stage", "of", "seconds", "of CPU", "each", "memory (GB)"], rows)}
"""


def _measured(name: str, amount: str, work: Callable[[], object], each: Callable[[float], str]) -> Stage:
    """A stage, with its times and peak memory. each: of its processor seconds."""
    reset_host_peak()
    empty, start, used = host_peak(), time.perf_counter(), time.process_time()
    work()
    seconds, cpu = time.perf_counter() - start, time.process_time() - used
    return Stage(name, amount, seconds, cpu, each(cpu), host_peak() - empty)


def _scene(out: Path, photos: int, points: int = 2_000) -> Path:
    from lab.benchmarks.crowd import write_crowd

    folder = out / f"scene-{photos}-{points}"
    return folder if folder.is_dir() else write_crowd(folder, photos, points, zoom=_ZOOM)


def _photos(folder: Path) -> list[Photo]:
    from lang3dxl_ns.scene.colmap import read_reconstruction
    from lang3dxl_ns.scene.photo import Photo

    tracked = read_reconstruction(folder / "sparse" / "0").photos.values()
    return [Photo.from_model(t, folder / "images" / t.name).at_most(1600) for t in tracked]


def _reading(out: Path, count: int) -> list[Stage]:
    """Decoding once, reading the copies, and waiting for them in steps, with a tenth in memory."""
    from concurrent.futures import ThreadPoolExecutor

    from lang3dxl_ns.preparation.photo_cache import PhotoCache
    from lang3dxl_ns.preparation.store import FeatureStore
    from lang3dxl_ns.preparation.working_photos import WorkingPhotos

    photos = _photos(_scene(out, count))
    store = FeatureStore(out / f"working-{time.time_ns()}")
    working = WorkingPhotos(store)
    amount, repeated = f"{count} photos", photos * 5
    decoded = _measured(
        "decode, shrink, keep", amount, lambda: list(map(working.read, photos)), partial(_each, count)
    )
    megabytes = mean(path.stat().st_size for path in store.root.rglob("*.jpg")) / 1e6
    with ThreadPoolExecutor(2) as pool:
        read = _measured(
            "read the copies, 2 threads",
            f"{len(repeated)} photos",
            lambda: [image.shape for image in pool.map(working.read, repeated)],
            lambda cpu: f"{len(repeated) / cpu:.0f} a second of one core; {megabytes:.2f} MB",
        )
    size = sum(working.read(photo).nbytes for photo in photos)
    cache = PhotoCache(
        lambda i: {"image": working.read(photos[i % count])}, size * len(repeated) / count / 10
    )
    waits: list[float] = []

    def train() -> None:
        for place in range(len(repeated)):
            start = time.perf_counter()
            cache.get(place, list(range(place + 1, min(place + 17, len(repeated)))))
            waits.append(time.perf_counter() - start)
            time.sleep(_STEP_S)

    late = lambda _: f"waits {1e3 * mean(waits):.1f} ms, {mean(w > 0.001 for w in waits):.0%} of the steps"  # noqa: E731
    waiting = _measured("steps of 15 ms, a tenth in memory", f"{len(repeated)} photos", train, late)
    return [decoded, read, waiting]


def _start(out: Path) -> list[Stage]:
    """A second preparation of small photos, with nothing to do."""
    import numpy as np
    from PIL import Image

    from lang3dxl_ns.preparation.prepare import prepare
    from lang3dxl_ns.preparation.settings import PreparationConfig
    from lang3dxl_ns.preparation.store import FeatureStore
    from lang3dxl_ns.scene.camera import Lens
    from lang3dxl_ns.scene.photo import Photo

    folder, rng = out / "small", np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    photos = []
    for i in range(_STARTED):
        path = folder / f"{i}.jpg"
        if not path.exists():
            Image.fromarray(rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)).save(path)
        photos.append(Photo(path.name, path, None, Lens(64, 48, 60.0, 60.0, 32.0, 24.0)))
    config = PreparationConfig(clip="builtin", dense="none")
    again = partial(prepare, photos, None, config, [1.0], FeatureStore(out / "small-store"), "cpu")
    again()
    return [_measured("start, all prepared", f"{_STARTED:,} photos", again, partial(_each, _STARTED))]


def _crops(clip: str) -> list[Stage]:
    """Encoding of the crops of a photo, by a few of them."""
    import torch
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    from lang3dxl_ns.preparation.encoders import load_image_text_encoder
    from lang3dxl_ns.preparation.pyramid import choose_crops

    side, batch = 224, 8
    encode: Callable[[torch.Tensor], object]
    if clip == "builtin":
        encoder = load_image_text_encoder(clip, "cpu")
        side, batch, encode = encoder.crop_size, 256, encoder.encode_images
    else:
        config = CLIPVisionConfig(**_VISION[clip])  # type: ignore[arg-type]
        model = CLIPVisionModelWithProjection(config).eval().requires_grad_(False)
        encode = lambda crops: model(pixel_values=crops)  # noqa: E731
    crops = torch.rand(batch, 3, side, side)
    encode(crops)
    counts = {
        quality: choose_crops([0.05], 1 / 1600, (1600, 1200), True, side, quality).count(1200, 1600)
        for quality in ("fast", "normal", "fine")
    }

    def each(seconds: float) -> str:
        of_photo = (f"{q} {count:,} crops, {seconds / batch * count:.0f} s" for q, count in counts.items())
        return f"{1e3 * seconds / batch:.2f} ms; a photo: {', '.join(of_photo)}"

    return [_measured(f"encode with {clip}", f"{batch} crops", lambda: encode(crops), each)]


def _landmark_features(path: Path) -> tuple[Tensor, Tensor]:
    """CLIP features gathered onto a small landmark's Gaussians, and their mass; kept in a file."""
    from safetensors.torch import load_file, save

    from lab.baselines.lifting import LiftedFeatures
    from lab.landmark.demo_scene import DemoScene
    from lab.landmark.scene_writer import write_scene
    from lab.run_config import run_config
    from lang3dxl_ns.common.files import write_atomically
    from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer

    class Kept(LiftedFeatures):
        def learn_gaussians(self, gathered, *arguments):
            seen = gathered[gathered.mass > 0]
            write_atomically(path, save({"features": seen.features, "mass": seen.mass}))
            return super().learn_gaussians(gathered, *arguments)

    if not path.exists():
        data = path.parent / "landmark"
        if not data.is_dir():
            write_scene(DemoScene(data, seed=604, family="hall", photos=24, test_views=0))
        config = run_config(data, path.parent / "runs", "landmark", _LANDMARK_STEPS, "builtin", "builtin")
        settings = config.pipeline.datamanager
        settings.camera_res_scale_factor, settings.foreground = 0.5, "none"
        config.set_timestamp()
        config.save_config()
        trainer: Lang3DXLTrainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        for step in range(_LANDMARK_STEPS):
            trainer.pipeline.model.step_cb(trainer.optimizers, step)
            trainer.train_iteration(step)
        field = trainer.pipeline.model.semantic_field
        assert field is not None
        trainer.pipeline.model.semantic_field = Kept(field.clip_dim, 0)
        trainer.pipeline.learn_words()
    kept = load_file(path)
    return kept["features"], kept["mass"]


def _compression(out: Path, gaussians: int) -> list[Stage]:
    """The landmark's features, repeated until they are enough, with noise of 0.15 of their deviation."""
    import torch
    import torch.nn.functional as F

    from lang3dxl_ns.components.compression import CompressedField
    from lang3dxl_ns.components.feature_decoder import Gathered
    from lang3dxl_ns.components.semantic_field import SemanticFieldConfig

    features, mass = _landmark_features(out / "features.safetensors")
    rows, draw = torch.arange(gaussians) % len(features), torch.Generator().manual_seed(1)
    clean = features[rows]
    noisy = clean + _NOISE * features.std(0) * torch.randn(clean.shape, generator=draw)
    mean = noisy.mean(0)
    limit = float(F.cosine_similarity(clean - mean, noisy - mean, dim=1).mean())
    del clean
    field = CompressedField(SemanticFieldConfig("short"), features.shape[1])

    def said(_: float) -> str:
        return f"{field.learned}; of features and noise: {limit:.3f}"

    work = partial(field.learn_gaussians, Gathered(noisy, mass[rows]))
    return [_measured("compress", f"{gaussians:,} Gaussians", work, said)]


def _run(out: Path, photos: int, gaussians: int, steps: int) -> list[Stage]:
    """A run: preparation (none the second time), steps, words."""
    from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer

    config = _configuration(_scene(out, photos, gaussians), out, steps)
    config.save_config()
    trainer: Lang3DXLTrainer = config.setup(local_rank=0, world_size=1)
    amount = f"{gaussians:,} Gaussians"
    prepared = _measured(f"prepare {photos} photos", amount, trainer.setup, partial(_each, photos))
    pipeline = trainer.pipeline

    def train() -> None:
        for step in range(steps):
            pipeline.model.step_cb(trainer.optimizers, step)
            trainer.train_iteration(step)

    trained = _measured(f"{steps} steps", amount, train, partial(_each, steps))
    words = _measured("words", amount, pipeline.learn_words, partial(_each, photos))
    return [prepared, trained, words]


def _configuration(data: Path, out: Path, steps: int) -> Lang3DXLTrainerConfig:
    from lab.run_config import run_config

    config = run_config(data, out / "runs", "scale", steps, "builtin", "builtin")
    config.pipeline.datamanager.cache_dir = out / "targets"
    config.pipeline.model.sky_gaussians = 0
    config.set_timestamp()
    return config


def _each(count: int, seconds: float) -> str:
    return f"{seconds / count:.3g} s"
