"""Long and stiff optimizations of the semantic field alone, for drift, growth and breakdown over time."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import torch
from torch import Tensor

from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.components.losses import clip_loss
from lang3dxl_ns.components.semantic_field import SemanticField

PIXELS, BATCH, CHANNELS, KINDS = 1024, 64, 32, 12
NOISE = 0.3
"""Standard deviation of the targets around their cluster's mean, similar to crops of one thing."""
PARTS = 10
LARGEST_CODE = 25.0
"""Largest code that passes. From 17, float32's sigmoid has zero slope, so only momentum moves a code."""
DRIFT = 1.05
"""Factor by which the last part's loss may exceed the lowest part's."""


@dataclass
class Run:
    """An optimization and its figures in ten equal parts."""

    case: str
    steps: int
    converges: bool
    """Whether its loss must converge; its numbers must be finite in any case."""
    seconds: float = 0.0
    losses: list[float] = field(default_factory=list)
    """Mean loss over each part."""
    codes: list[float] = field(default_factory=list)
    """Largest code at the end of each part."""
    finite: bool = True
    """Whether all parameters and moments are finite at the end of every part."""

    @property
    def name(self) -> str:
        return f"optimization, {self.case}"

    @property
    def misses(self) -> list[str]:
        """Bounds exceeded, in words; empty for a pass."""
        found = [] if self.finite else ["not finite"]
        if self.converges and not self.losses[-1] <= DRIFT * min(self.losses):
            found.append(f"loss {self.losses[-1]:.3f}, was {min(self.losses):.3f}")
        if self.converges and not self.codes[-1] <= LARGEST_CODE:
            found.append(f"largest code {self.codes[-1]:.1f} > {LARGEST_CODE:.0f}")
        return found


def runs(quick: bool) -> list[Run]:
    """Run the catalog of optimizations, on the CPU, since the steps are too small for a GPU."""
    long = 1_000 if quick else 100_000
    steps = 200 if quick else 1_000
    return [
        optimize("usual rates, no decay", long, 1e-3, 5e-4, 5e-4),
        optimize("rates 1e6 apart, codes fast", steps, 10.0, 1e-3, 1e-5, converges=False),
        optimize("rates 1e6 apart, decoder fast", steps, 1e-5, 1e-3, 10.0, converges=False),
    ]


def optimize(
    case: str, steps: int, code_rate: float, grid_rate: float, decoder_rate: float, converges: bool = True
) -> Run:
    """Run Adam as in training (epsilon 1e-15), at constant rates, on pixels of a few kinds of things."""
    generator = torch.Generator().manual_seed(0)
    # A small table keeps a step to a millisecond or two.
    config = SemanticFieldConfig(preset="short", log2_table_size=9)
    model = SemanticField(config, CHANNELS, generator=generator)
    kinds = torch.randn(KINDS, CHANNELS, generator=generator)
    targets = kinds[torch.randint(KINDS, (PIXELS,), generator=generator)]
    codes = (0.01 * torch.randn(PIXELS, model.code_dim, generator=generator)).requires_grad_()
    groups: list[tuple[list[Tensor], float]] = [
        ([codes], code_rate),
        ([*model.parameter_groups()["field_encoding"]], grid_rate),
        ([*model.parameter_groups()["field_decoder"]], decoder_rate),
    ]
    adam = torch.optim.Adam([{"params": p, "lr": rate} for p, rate in groups], eps=1e-15, fused=True)
    weight = torch.ones(1, BATCH)

    def step() -> float:
        chosen = torch.randint(PIXELS, (BATCH,), generator=generator)
        target = targets[chosen] + NOISE * torch.randn(BATCH, CHANNELS, generator=generator)
        loss = clip_loss(model.decode_clip(codes[chosen])[None], target[None], weight)
        adam.zero_grad()
        loss.backward()
        adam.step()
        return loss.item()

    run, start = Run(case, steps, converges), time.process_time()
    for _ in range(PARTS):
        losses = [step() for _ in range(steps // PARTS)]
        run.losses.append(math.fsum(losses) / len(losses))
        run.codes.append(float(codes.detach().abs().max()))
        run.finite &= _all_finite(adam)
    run.seconds = time.process_time() - start
    return run


def _all_finite(optimizer: torch.optim.Optimizer) -> bool:
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = [value for state in optimizer.state.values() for value in state.values()]
    tensors: list[Tensor] = [*parameters, *moments]
    return all(bool(tensor.isfinite().all()) for tensor in tensors)
