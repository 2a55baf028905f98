"""Hard cases of the attenuated downsampler."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from lab.numerics.measure import EXACT, Bounds, Case, Maps, Problem, narrowed
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler, DownsamplerConfig, separable_kernel

CHANNELS = 12
SIZE, GRID, SIDES = (18, 24), (6, 8), (0.15, 0.4)
BOUNDS = {"float32": Bounds(1e-5, 3e-6, 1e-4, 3e-5), "float64": EXACT}
HALF = {"bf16": Bounds(2e-2, 1e-2, 3e-2, 2e-2), "fp16": Bounds(3e-3, 2e-3, 5e-3, 3e-3)}


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Yield cases of shapes and masks with bounded logits, and of extreme logits, free and bounded."""
    shapes: dict[str, dict[str, Any]] = {
        "usual": {},
        "size that doesn't divide": {"grid": (5, 7)},
        "map smaller than the grid": {"size": (5, 6), "grid": (9, 11)},
        "windows wider than the map": {"sides": (1.5, 4.0)},
        "grid 1×1": {"grid": (1, 1)},
        "map 1×1": {"size": (1, 1), "grid": (3, 4)},
        "mask empties whole windows": {"mask": _half_mask},
        "mask is empty": {"mask": lambda size: torch.zeros(size, dtype=torch.float64)},
        "mask of 1e-6": {"mask": lambda size: torch.full(size, 1e-6, dtype=torch.float64)},
    }
    for name, changes in shapes.items():
        yield Case("downsampler", name, partial(_problem, _normal(1.0), bound=10.0, **changes), BOUNDS)
    logits: dict[str, Callable[[tuple[int, int]], Tensor]] = {
        "logits ±200": _normal(200.0),
        "logits ±1e4": _normal(1e4),
        "one pixel at 1e4": lambda size: _normal(1.0)(size).flatten().index_fill(
            0, torch.tensor([100]), 1e4).view(size),
        "−∞ in some pixels": lambda size: _normal(1.0)(size).masked_fill(_normal(1.0)(size) > 1, -math.inf),
        "−∞ in whole windows": lambda size: torch.where(_half_mask(size) > 0, _normal(1.0)(size), -math.inf),
    }  # fmt: skip
    for name, values in logits.items():
        yield Case("downsampler", f"{name}, free", partial(_problem, values, bound=None), BOUNDS)
        yield Case("downsampler", f"{name}, bound 10", partial(_problem, values, bound=10.0), BOUNDS)
    yield Case(
        "downsampler",
        "logits ±1e4 and empty windows, free",
        partial(_problem, _normal(1e4), bound=None, mask=_half_mask),
        BOUNDS,
    )
    yield Case(
        "downsampler",
        "mixed precision",
        partial(_problem, _normal(1e4), bound=10.0, narrow=True),
        HALF,
        "the features arrive in 16 bits; the averages are taken in float32",
    )


def _normal(scale: float) -> Callable[[tuple[int, int]], Tensor]:
    def make(size: tuple[int, int]) -> Tensor:
        return scale * torch.randn(size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    return make


def _half_mask(size: tuple[int, int]) -> Tensor:
    """Build a mask that is 1 on the left third and 0 elsewhere."""
    mask = torch.zeros(size, dtype=torch.float64)
    mask[:, : size[1] // 3] = 1
    return mask


class _Given(nn.Module):
    """Replacement of the network that returns the case's logits."""

    def __init__(self, logits: Tensor):
        super().__init__()
        self.logits = logits

    def forward(self, _: Tensor) -> Tensor:
        return self.logits[None, None]


def _problem(
    logits: Callable[[tuple[int, int]], Tensor],
    bound: float | None,
    size: tuple[int, int] = SIZE,
    grid: tuple[int, int] = GRID,
    sides: tuple[float, ...] = SIDES,
    mask: Callable[[tuple[int, int]], Tensor] | None = None,
    narrow: bool = False,
) -> Problem:
    config = DownsamplerConfig(kernel="pyramid", logit_bound=bound)
    module = AttenuatedDownsampler(config, CHANNELS, generator=torch.Generator().manual_seed(0))
    features = _normal(1.0)((*size, CHANNELS))  # type: ignore[arg-type]
    leaves = {"features": features, "logits": logits(size)}
    chosen = None if mask is None else mask(size)

    def compute(given: Maps) -> Maps:
        module.network = _Given(given["logits"])  # type: ignore[assignment]
        values = narrowed(given["features"]) if narrow else given["features"]
        used = None if chosen is None else chosen.to(values.device)
        out, share = module(values, grid, sides, used)
        return {"out": out, "share": share}

    def reference(given: Maps) -> Maps:
        weights = given["logits"] if bound is None else bound * torch.tanh(given["logits"] / bound)
        values = given["features"]
        used = torch.ones(size, dtype=torch.float64) if chosen is None else chosen
        return downsample_reference(values, weights, used.to(values.device), grid, sides)

    # If a window holds one pixel, or one outweighs all others, the gradient of the logits nearly vanishes.
    return Problem(leaves, compute, reference, gradient_scale=0.1)


def downsample_reference(
    features: Tensor, logits: Tensor, mask: Tensor, grid: tuple[int, int], sides: tuple[float, ...]
) -> Maps:
    """Compute Σ K m exp(w) f / Σ K m exp(w) window by window, with each one's largest logit subtracted."""
    h, w, _ = features.shape
    rows, columns = separable_kernel("pyramid", (h, w), grid, sides, torch.float64, features.device)
    out = features.new_zeros(*grid, features.shape[2])
    share = features.new_zeros(grid)
    for i in range(grid[0]):
        for k in range(grid[1]):
            kernel = mask * (rows[:, i, :, None] * columns[:, k, None, :]).sum(0)
            share[i, k] = kernel.sum()
            used = (kernel > 0) & (logits > -math.inf)
            if used.any():
                weights = kernel[used] * torch.exp(logits[used] - logits[used].max().detach())
                out[i, k] = weights @ features[used] / weights.sum()
    return {"out": out, "share": share}
