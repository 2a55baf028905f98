"""LangSplat (Qin et al. 2024): a per-scene autoencoder's three numbers on every Gaussian."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig

_ENCODER = (256, 128, 64, 32, 3)
_DECODER = (16, 32, 64, 128, 256, 256)
_STEPS, _BATCH = 2_000, 1_024
_RATE = 2e-3
"""Learning rate of the autoencoder. It is higher than the published 7e-4, which is for batches of 64."""
_MOST_FEATURES = 400_000
"""Most features the autoencoder is trained on."""


class LangSplat(Decoder):
    """Decoder of unit-length codes after rendering: the frozen second half of an autoencoder.

    The autoencoder learns the scene's CLIP targets before the run, as unit vectors, in `_STEPS` iterations;
    decoded features are scaled back to the targets' typical length. There are no dense features. The
    published system trains a model for each of three levels of SAM segments; this one uses the targets that
    all decoders share here."""

    seconds = 0.0
    """Duration of `learn_targets` in this process."""

    def __init__(self, clip_dim: int) -> None:
        super().__init__(clip_dim, 0)
        self.decoder = _layers((3, *_DECODER, clip_dim)).requires_grad_(False)
        self.first_code: Tensor
        self.norm: Tensor
        self.register_buffer("first_code", torch.tensor([0.0, 0.0, 1.0]))
        self.register_buffer("norm", torch.ones(()))

    @classmethod
    def build(
        cls, settings: SemanticFieldConfig, clip_dim: int, compression: CompressionConfig, dense_dim: int
    ) -> LangSplat:
        return cls(clip_dim)

    def initial_codes(self, count: int) -> Float[Tensor, "count 3"]:
        """Return codes that all lie near the code of the mean target."""
        return self.first_code + 0.1 * torch.randn(count, 3).to(self.first_code)

    def carried(self, gaussians: dict[str, Tensor]) -> Float[Tensor, "n 3"]:  # type: ignore[override]
        return F.normalize(gaussians["codes"], dim=-1)

    def forward(self, rendered: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch clip"], None]:
        return self.norm * F.normalize(self.decoder(rendered), dim=-1), None

    def set_output_statistics(self, mean: Float[Tensor, " out"], std: Float[Tensor, " out"]) -> None:
        """Set the typical length of the CLIP targets; the dense statistics are ignored."""
        mean, std = mean[: self.clip_dim], std[: self.clip_dim]
        super().set_output_statistics(mean, std)
        self.norm.copy_((mean.square() + std.square()).sum().sqrt())

    def learn_targets(self, targets: Callable[[], Iterable[Float[Tensor, "h w clip"]]]) -> None:
        """Train the autoencoder on the scene's targets."""
        start = time.perf_counter()
        generator = torch.Generator().manual_seed(0)
        features = _sample(targets(), generator).to(self.norm.device)
        with torch.random.fork_rng(devices=[]), torch.enable_grad():
            torch.manual_seed(0)
            encoder = _layers((self.clip_dim, *_ENCODER), normalize=True).to(features)
        self.decoder.requires_grad_(True)
        parameters = [*encoder.parameters(), *self.decoder.parameters()]
        optimizer = torch.optim.Adam(parameters, lr=_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _STEPS)
        for _ in range(_STEPS):
            batch = features[torch.randint(len(features), (_BATCH,), generator=generator)]
            decoded = F.normalize(self.decoder(F.normalize(encoder(batch), dim=-1)), dim=-1)
            cosine = F.cosine_similarity(decoded, batch, dim=-1).mean()
            loss = F.mse_loss(decoded, batch) + 1e-3 * (1 - cosine)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        self.decoder.requires_grad_(False)
        with torch.no_grad():
            mean = F.normalize(features.mean(0, keepdim=True), dim=-1)
            self.first_code.copy_(F.normalize(encoder.eval()(mean), dim=-1)[0])
        LangSplat.seconds += time.perf_counter() - start


def _sample(targets: Iterable[Tensor], generator: torch.Generator) -> Float[Tensor, "n c"]:
    """Collect the targets' pixels as unit vectors, subsampled if there are too many."""
    rows: list[Tensor] = []
    for target in targets:
        flat = F.normalize(target.flatten(0, 1).float(), dim=-1)
        rows.append(flat)
        if sum(map(len, rows)) > _MOST_FEATURES:
            rows = [part[torch.randperm(len(part), generator=generator)[: len(part) // 2]] for part in rows]
    return torch.cat(rows)


def _layers(widths: tuple[int, ...], normalize: bool = False) -> nn.Sequential:
    """Build linear layers with ReLU between, preceded by batch normalization if requested."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        if layers:
            layers += [nn.BatchNorm1d(inputs), nn.ReLU()] if normalize else [nn.ReLU()]
        layers.append(nn.Linear(inputs, outputs))
    return nn.Sequential(*layers)
