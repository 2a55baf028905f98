"""What compression to a few numbers costs in words as scenes grow.

Features gathered onto the Gaussians of a finished demo are repeated, with noise of 0.15 of their deviation,
until they are as many as a large scene has. Each Gaussian of the demo then answers with the mean relevancy
of its repetitions: by the features themselves, and by the codes that they are compressed to.

    python -m lab.benchmarks.compressed_words --run DIR --out REPORT.md

DIR is what `lang3dxl demo --out DIR` wrote: `run/` and `scene/`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float, Int
from torch import Tensor

from lab.benchmarks.dense_teacher import gathered_crops, words
from lang3dxl_ns.common.console import say
from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.components.feature_decoder import Gathered
from lang3dxl_ns.components.semantic_field import SemanticFieldConfig
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.files.scene_file import read_scene
from lang3dxl_ns.query.engine import PerGaussian, QueryEngine, make_engine
from lang3dxl_ns.query.relevancy import Queries

NOISE = 0.15
"""Noise of repeated features, as a share of the deviation of each channel."""


@dataclass
class CompressedWords:
    """Score words of repeated features, compressed and not."""

    run: Path
    """Folder that `lang3dxl demo --out` wrote."""
    out: Path
    """The report."""
    gaussians: tuple[int, ...] = (18_000, 300_000, 1_000_000)
    """Numbers of Gaussians to repeat the features to."""


@dataclass(frozen=True)
class Repeated:
    """Answers for the Gaussians of a scene by the mean relevancy of their repetitions."""

    all: QueryEngine
    owner: Int[Tensor, " m"]
    """The Gaussian that each repetition belongs to."""
    count: int
    head = None

    @property
    def temperature(self) -> float:
        return self.all.temperature

    def of_gaussians(self, queries: Queries) -> Float[Tensor, "q n"]:
        relevancy = self.all.of_gaussians(queries)
        sums = relevancy.new_zeros(len(relevancy), self.count).index_add_(1, self.owner, relevancy)
        return sums / self.owner.bincount(minlength=self.count).clamp_min(1)

    def channels(self, queries: Queries) -> Float[Tensor, "n q"]:
        return self.of_gaussians(queries).T.contiguous()

    def maps(self, rendered: Float[Tensor, "h w q"], queries: Queries) -> Float[Tensor, "q h w"]:
        return rendered.permute(2, 0, 1)


def main(config: CompressedWords) -> None:
    scene = read_scene(next((config.run / "run").rglob("*.scene")))
    truth = GroundTruth(config.run / "scene" / "ground_truth")
    temperature, everything = scene.engine.temperature, len(scene.splats.means)
    features, mass = gathered_crops(config.run, scene)
    seen = (mass > 0).nonzero()[:, 0]
    features, mass = features[seen], mass[seen]
    lines: list[str] = []

    def score(engine: QueryEngine, rows: Int[Tensor, " m"]) -> dict[str, float]:
        return words(scene, Repeated(engine, seen[rows], everything), truth)  # type: ignore[arg-type]

    for count in config.gaussians:
        rows, draw = torch.arange(count) % len(seen), torch.Generator().manual_seed(1)
        noisy = features[rows]
        noisy += NOISE * features.std(0) * torch.randn(noisy.shape, generator=draw)
        unit = PerGaussian(F.normalize(noisy, dim=1).half(), temperature=temperature)
        plain = score(unit, rows)
        del unit
        start, field = time.process_time(), CompressedField(SemanticFieldConfig("short"), features.shape[1])
        codes = field.learn_gaussians(Gathered(noisy, mass[rows]))
        seconds = time.process_time() - start
        found = score(make_engine(field, codes, temperature), rows)
        if not lines:
            names = " | ".join(plain)
            lines = [f"| Gaussians | | seconds | mAP | {names} |", "|---" * (len(plain) + 4) + "|"]
        for name, time_s, figures in (("features", "", plain), (field.learned, f"{seconds:.0f}", found)):
            each = " | ".join(f"{value:.3f}" for value in figures.values())
            lines.append(
                f"| {count:,} | {name} | {time_s} | {np.mean(list(figures.values())):.4f} | {each} |"
            )
        say("\n".join(lines))
        config.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(tyro.cli(CompressedWords))
