"""A dense teacher without weights to download: is one pass of a dense encoder that speaks CLIP's language
better than crops?

A linear layer is fitted from the built-in dense encoder's patch tokens to the built-in CLIP's embedding of
the crop around each token, on training landmarks and training façades. Features are then gathered onto the
Gaussians of finished scenes from the crops, from the dense maps, and relevancies of both are averaged.

    python -m lab.benchmarks.dense_teacher --runs DIR [DIR ...] --facades DIR --out REPORT.md

Each DIR is what `lang3dxl demo --out DIR` wrote: `run/` and `scene/`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from lab.landmark.landmark import Landmark
from lab.landmark.photography import random_view, take_photo
from lang3dxl_ns.attachment.learn import prepare_photos, settled
from lang3dxl_ns.common.console import say
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.score_scene import score_scene
from lang3dxl_ns.files.scene_file import read_scene
from lang3dxl_ns.preparation.encoders import (
    DenseEncoder,
    ImageTextEncoder,
    load_dense_encoder,
    load_image_text_encoder,
)
from lang3dxl_ns.preparation.pyramid import THIRD, build_clip_target
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.targets import TargetReader
from lang3dxl_ns.query.engine import PerGaussian
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.rendering import composite
from lang3dxl_ns.rendering.gathering import Pixels, gather
from lang3dxl_ns.scene.camera import resized
from lang3dxl_ns.scene.capture import open_capture
from lang3dxl_ns.scene.record import ScenePhoto
from lang3dxl_ns.training.learn_codes import DENSE_AXES
from lang3dxl_ns.training.sharpening import sharpen

TRAINING_SEEDS = range(10_000, 20_000)
"""Landmarks of the built-in encoders' own training."""
SIDES = (0.08, 0.11)
"""Crops of the fitted photos, as shares of their width: about the fine crops of the demo."""
GATHERED = 240
"""Pixels of the longer side at which photos are gathered."""
Photo = Float[Tensor, "h w 3"]
Map = Float[Tensor, "t t c"]


@dataclass(frozen=True, eq=False)
class Averaged:
    """The mean of the relevancies of two sets of features of the same Gaussians."""

    both: tuple[PerGaussian, PerGaussian]
    head = None

    @property
    def temperature(self) -> float:
        return self.both[0].temperature

    def of_gaussians(self, queries: Queries) -> Float[Tensor, "q n"]:
        return torch.stack([engine.of_gaussians(queries) for engine in self.both]).mean(0)

    def channels(self, queries: Queries) -> Float[Tensor, "n q"]:
        return self.of_gaussians(queries).T.contiguous()

    def maps(self, rendered: Float[Tensor, "h w q"], queries: Queries) -> Float[Tensor, "q h w"]:
        return rendered.permute(2, 0, 1)

    def features(self, rows) -> Float[Tensor, "m c"]:
        return self.both[0].features(rows)

    def calibrated(self, words: Queries) -> Averaged:
        return Averaged((self.both[0].calibrated(words), self.both[1].calibrated(words)))


@dataclass(frozen=True)
class Teacher:
    """A linear reading of dense features as CLIP's."""

    weight: Float[Tensor, "d1 c"]

    @classmethod
    def of(
        cls, photos: Iterator[Photo], clip: ImageTextEncoder, dense: DenseEncoder, ridge: float = 1e-3
    ) -> Teacher:
        """Fitted by least squares to unit embeddings of the crops around the tokens."""
        count = dense.dim + 1
        gram = torch.zeros(count, count, dtype=torch.float64)
        moment = torch.zeros(count, clip.dim, dtype=torch.float64)
        for photo in photos:
            tokens = _with_one(dense.encode(photo)).flatten(0, 1).double()
            crops = _crops(photo, clip).permute(2, 0, 1)[None]
            wanted = F.interpolate(crops, (dense.tokens,) * 2, mode="bilinear", align_corners=False)[0]
            wanted = F.normalize(wanted.permute(1, 2, 0), dim=-1).flatten(0, 1).double()
            gram += tokens.T @ tokens
            moment += tokens.T @ wanted
        gram += ridge * gram.diagonal().mean() * torch.eye(count, dtype=torch.float64)
        return cls(torch.linalg.solve(gram, moment).float())

    def read(self, dense: Float[Tensor, "t t d"]) -> Map:
        return _with_one(dense.float()) @ self.weight


def _with_one(dense: Float[Tensor, "t t d"]) -> Float[Tensor, "t t d1"]:
    return F.pad(F.normalize(dense.float(), dim=-1), (0, 1), value=1.0)


def _crops(photo: Photo, clip: ImageTextEncoder) -> Float[Tensor, "h w c"]:
    sides = [round(share * photo.shape[1]) for share in SIDES]
    lit = clip.in_known_light(photo)
    target = build_clip_target(lit, sides, clip.encode_images, clip.crop_size, 512, THIRD)
    return target.features.float()


def training_photos(landmarks: int, views: int, facades: Path | None, street: int) -> Iterator[Photo]:
    """Wild views of training landmarks, and street façades of the training split."""
    for seed in TRAINING_SEEDS[:landmarks]:
        landmark, rng = Landmark.from_seed(seed), np.random.default_rng((seed, 1))
        for _ in range(views):
            shot = take_photo(landmark, random_view(landmark, rng, wild=True), 480, 360)
            yield torch.from_numpy(shot.image.copy()).float() / 255
    if facades is not None:
        for path in sorted(facades.rglob("*train*.jpg"))[:street]:
            yield torch.from_numpy(np.array(Image.open(path).convert("RGB"))).float() / 255


@dataclass
class Comparison:
    """Compare crops, a dense teacher, and both on finished demos."""

    runs: tuple[Path, ...]
    """Folders that `lang3dxl demo --out` wrote."""
    out: Path
    """The report."""
    facades: Path | None = None
    """Street photos to fit on, beside landmarks."""
    landmarks: int = 24
    """Training landmarks to fit on."""
    views: int = 4
    """Photos of each."""
    street: int = 60
    """Street photos to fit on."""


def engine_of(scene: Scene, features: Float[Tensor, "n c"]) -> PerGaussian:
    rows = F.normalize(torch.where(features.isfinite(), features, 0.0), dim=1).half()
    return PerGaussian(rows, temperature=scene.engine.temperature)


@dataclass(frozen=True, eq=False)
class Gathering:
    """The training photos of a finished demo, whose features can be gathered onto its Gaussians."""

    scene: Scene
    photos: dict[str, ScenePhoto]
    targets: TargetReader

    @classmethod
    def of(cls, run: Path, scene: Scene) -> Gathering:
        photos = {photo.name: photo for photo in scene.photos if photo.split == "train"}
        collection = open_capture(run / "scene")
        collection = replace(collection, photos=[p for p in collection.photos if p.name in photos])
        config = settled(PreparationConfig(clip="builtin"))
        _, targets = prepare_photos(collection, config, run / "scene" / "lang3dxl_cache", "cpu")
        return cls(scene, photos, targets)

    def dense(self, name: str) -> Float[Tensor, "t t d"]:
        """The dense features of a photo."""
        found = self.targets.dense(name)
        assert found is not None
        return found.float()

    @torch.no_grad()
    def features(
        self, read: Callable[[str], Float[Tensor, "h w c"]]
    ) -> tuple[Float[Tensor, "n c"], Float[Tensor, " n"]]:
        """Sharpened features of all Gaussians, and their mass. read: the feature map of a photo."""
        width = self.targets.clip_dim
        basis = PrincipalBasis.of((F.normalize(self.dense(n), dim=-1) for n in self.photos), DENSE_AXES)

        def views():
            for name, photo in self.photos.items():
                camera = resized(photo.camera, GATHERED)
                groups = basis.coordinates(F.normalize(self.dense(name), dim=-1))
                pixels = Pixels.of([read(name), groups], (camera.height, camera.width), None)
                yield partial(composite, self.scene.splats, camera), pixels

        means = self.scene.splats.means
        features, mass = gather(len(means), views(), width + basis.axes.shape[1], means)
        return sharpen(features[:, :width], features[:, width:], mass), mass


def gathered_crops(run: Path, scene: Scene) -> tuple[Float[Tensor, "n c"], Float[Tensor, " n"]]:
    """Features of the crops of a demo's training photos on its Gaussians, and the Gaussians' mass."""
    gathering = Gathering.of(run, scene)
    return gathering.features(lambda name: gathering.targets.clip(name).features.float())


@torch.no_grad()
def words(scene: Scene, engine: PerGaussian | Averaged, truth: GroundTruth) -> dict[str, float]:
    """AP of each word over the labeled photos."""
    scene.__dict__["engine"] = engine
    figures, _ = score_scene(scene, truth, "all")
    return {
        word: float(np.mean([f[f"ap_{word}"] for f in figures.values() if f"ap_{word}" in f]))
        for word in truth.categories
    }


@torch.no_grad()
def compare(run: Path, teacher: Teacher) -> list[tuple[str, dict[str, float]]]:
    """AP of each word in the labeled views, by where features come from."""
    scene = read_scene(next((run / "run").rglob("*.scene")))
    truth = GroundTruth(run / "scene" / "ground_truth")
    gathering = Gathering.of(run, scene)
    targets = gathering.targets

    def gathered(read: Callable[[str], Float[Tensor, "h w c"]]) -> PerGaussian:
        return engine_of(scene, gathering.features(read)[0])

    crops = gathered(lambda name: targets.clip(name).features.float())
    dense = gathered(lambda name: teacher.read(gathering.dense(name)))
    rows: list[tuple[str, PerGaussian | Averaged]] = [("crops", crops), ("dense", dense)]
    rows.append(("both", Averaged((crops, dense))))
    found = []
    for name, engine in rows:
        found.append((name, words(scene, engine, truth)))
    return found


def main(config: Comparison) -> None:
    torch.manual_seed(0)
    clip, dense = load_image_text_encoder("builtin", "cpu"), load_dense_encoder("builtin", "cpu")
    start = time.process_time()
    photos = training_photos(config.landmarks, config.views, config.facades, config.street)
    teacher = Teacher.of(photos, clip, dense)
    say(f"fitted in {time.process_time() - start:.0f} s of the processor")
    seconds = price(clip, dense)
    lines = [
        f"One photo of 480×360: crops {seconds[0]:.2f} s, one dense pass {seconds[1]:.2f} s of a core",
        "",
    ]
    for run in config.runs:
        rows = compare(run, teacher)
        words = list(rows[0][1])
        lines += [f"| {run.name} | mAP | {' | '.join(words)} |", "|---" * (len(words) + 2) + "|"]
        for name, found in rows:
            mean = np.mean(list(found.values()))
            lines.append(f"| {name} | {mean:.3f} | " + " | ".join(f"{v:.3f}" for v in found.values()) + " |")
        lines.append("")
        say("\n".join(lines[-len(rows) - 3 :]))
        config.out.write_text("\n".join(lines))


def price(clip: ImageTextEncoder, dense: DenseEncoder) -> tuple[float, float]:
    """Processor seconds of the crops and of the dense pass of one photo."""
    photo = torch.rand(360, 480, 3)
    seconds = []
    for work in (lambda: _crops(photo, clip), lambda: dense.encode(photo)):
        work()
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return seconds[0], seconds[1]


if __name__ == "__main__":
    main(tyro.cli(Comparison))
