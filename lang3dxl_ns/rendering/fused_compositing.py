"""Compositing on the CPU in fused kernels: the function of `torch_rasterizer`, but many times as fast."""

from __future__ import annotations

import math
import threading
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from lang3dxl_ns.common.jit import in_threads, kernel, ranges
from lang3dxl_ns.rendering.fused_plan import make_plan
from lang3dxl_ns.rendering.fused_tiles import (
    CHANNELS_FROM,
    PIXELS,
    WAVE,
    Maps,
    Trace,
    backward_tiles,
    composite_tiles,
)

PARTS_PER_THREAD = 8
"""Parts per thread. Tiles may stop early, by an unknown amount, so small parts spread the rest over the
threads."""
_MOST_KEPT = 64 * 2**20  # bytes


class _Kept(threading.local):
    """Memory kept from one backward pass to the next. New pages would cost more than the sums themselves."""

    memory = np.empty(0, np.uint8)

    def take(self, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        """Return an array of arbitrary content that is valid until the thread takes the next one."""
        size = math.prod(shape) * dtype.itemsize
        if size > _MOST_KEPT:
            return np.empty(shape, dtype)
        if len(self.memory) < size:
            self.memory = np.empty(size, np.uint8)
        return self.memory[:size].view(dtype).reshape(shape)


_kept = _Kept()


class FusedCompositing(torch.autograd.Function):
    """Compositing as in `torch_rasterizer.Compositing`, compiled. The variances get no gradient."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        channels: Tensor,
        detached_channels: Tensor,
        variances: Tensor,
        depths: Tensor,
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        plan = make_plan(
            means2d.view(-1, 2), conics, variances, depths, opacities, channels, detached_channels, width,
            height,
        )  # fmt: skip
        ctx.sizes = channels.shape[1], detached_channels.shape[1], 1
        maps = tuple(channels.new_empty(height, width, size) for size in ctx.sizes)
        rows, keep = np.diff(plan.starts), any(ctx.needs_input_grad)
        waves = -(-rows // WAVE) if keep else np.zeros_like(rows)
        wave_starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(waves)])
        records = np.empty((wave_starts[-1], PIXELS), plan.splats.dtype)
        trace = Trace(wave_starts, records, np.zeros(len(rows), np.int64))
        shared = plan, Maps(*(part.numpy() for part in maps)), trace, keep
        in_threads(composite_tiles, [(tiles, *shared) for tiles in _parts(rows)])
        ctx.save_for_backward(means2d, conics, opacities)
        ctx.set_materialize_grads(False)
        ctx.plan, ctx.trace = plan, trace
        return maps[0], maps[1], maps[2]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> Any:  # type: ignore[override]
        means2d, conics, opacities = ctx.saved_tensors
        plan, positions = ctx.plan, means2d.view(-1, 2)
        slopes = (
            opacities.new_zeros(plan.height, plan.width, size) if slope is None else slope.contiguous()
            for slope, size in zip(upstream, ctx.sizes, strict=True)
        )
        maps = Maps(*(slope.numpy() for slope in slopes))
        threads = torch.get_num_threads()
        parts = _parts(ctx.trace.ends)
        # Every thread has fixed tiles and its own sums, so the result does not depend on their order.
        dealt = [np.concatenate(parts[k::threads]) for k in range(min(threads, len(parts)))]
        columns = CHANNELS_FROM + plan.table.shape[1]
        sums = _kept.take((len(dealt), len(plan.order), columns), plan.splats.dtype)
        in_threads(backward_tiles, [(tiles, plan, maps, ctx.trace, sums[k]) for k, tiles in enumerate(dealt)])
        found = [torch.zeros_like(part) for part in (positions, conics, opacities)]
        found += [opacities.new_zeros(len(opacities), size) for size in ctx.sizes[:2]]
        arrays = plan, conics.numpy(), opacities.numpy(), sums, _Gradients(*(g.numpy() for g in found))
        in_threads(_collect, [(*part, *arrays) for part in ranges(len(plan.order), least=4096)])
        return found[0].view_as(means2d), *found[1:], *[None] * 4


class _Gradients(NamedTuple):
    """Gradients per Gaussian."""

    position: Float[np.ndarray, "n 2"]
    conic: Float[np.ndarray, "n 3"]
    opacity: Float[np.ndarray, " n"]
    channels: Float[np.ndarray, "n c"]
    detached: Float[np.ndarray, "n d"]


def _parts(work: np.ndarray) -> list[np.ndarray]:
    """Split the tiles into consecutive parts of about equal work, several per thread. Empty tiles count a
    little, too."""
    threads = torch.get_num_threads()
    parts = PARTS_PER_THREAD * threads if threads > 1 else 1
    ends = np.cumsum(work + 8.0)
    limits = np.searchsorted(ends, np.linspace(0, ends[-1], parts + 1)[1:-1])
    return [tiles for tiles in np.split(np.arange(len(work)), limits) if len(tiles)]


@kernel
def _collect(first, last, plan, conics, opacities, sums, found) -> None:
    """Collect the gradients of a range of Gaussians from the sums of all threads."""
    row = np.empty(sums.shape[2], sums.dtype)
    for rank in range(first, last):
        row[:] = sums[0, rank]
        for part in range(1, len(sums)):
            row += sums[part, rank]
        g = plan.order[rank]
        a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
        found.conic[g, 0], found.conic[g, 1], found.conic[g, 2] = -0.5 * row[0], -row[1], -0.5 * row[2]
        # dx and dy point from the center to the pixel.
        found.position[g, 0], found.position[g, 1] = a * row[3] + b * row[4], b * row[3] + c * row[4]
        found.opacity[g] = row[5] / opacities[g]
        for k in range(found.channels.shape[1]):
            found.channels[g, k] = row[CHANNELS_FROM + k]
        for k in range(found.detached.shape[1]):
            found.detached[g, k] = row[CHANNELS_FROM + plan.attached + k]
