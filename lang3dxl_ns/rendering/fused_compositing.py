"""Compositing on the CPU in fused kernels: the function of `torch_rasterizer`, but many times as fast."""

from __future__ import annotations

import math
import threading
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from lang3dxl_ns.common.jit import in_threads, kernel, ranges
from lang3dxl_ns.common.kernels import MOST_SUMS
from lang3dxl_ns.rendering.fused_tiles import (
    CHANNELS_FROM,
    PIXELS,
    SPLAT_COLUMNS,
    TILE,
    UNROLL,
    WAVE,
    Maps,
    Trace,
    backward_tiles,
    composite_tiles,
)
from lang3dxl_ns.rendering.gaussians import REACH_SLACK

PARTS_PER_THREAD = 8
"""Parts per thread. Tiles may stop early, by an unknown amount; small parts spread the rest over threads."""
LOG2_E = math.log2(math.e)
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
    """Compositing as in `torch_rasterizer.Compositing`, compiled. As there, an ellipse's shape depends on
    xx and xy of its conic and on its variance yy, and only these get the shape's gradient."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        plan, (means2d, conics, opacities, channels, variances, *_) = make_plan(*inputs), inputs
        ctx.sizes = channels.shape[1], 1
        maps = tuple(channels.new_empty(plan.height, plan.width, size) for size in ctx.sizes)
        rows, keep = np.diff(plan.starts), any(ctx.needs_input_grad)
        waves = -(-rows // WAVE) if keep else np.zeros_like(rows)
        wave_starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(waves)])
        records = np.empty((wave_starts[-1], PIXELS), plan.splats.dtype)
        trace = Trace(wave_starts, records, np.zeros(len(rows), np.int64))
        shared = plan, Maps(*(part.numpy() for part in maps)), trace, keep
        in_threads(composite_tiles, [(tiles, *shared) for tiles in _parts(rows)])
        ctx.save_for_backward(means2d, conics, opacities, variances)
        ctx.set_materialize_grads(False)
        ctx.plan, ctx.trace = plan, trace
        return maps[0], maps[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> Any:  # type: ignore[override]
        means2d, conics, opacities, variances = ctx.saved_tensors
        plan, positions = ctx.plan, means2d.view(-1, 2)
        slopes = (
            opacities.new_zeros(plan.height, plan.width, size) if slope is None else slope.contiguous()
            for slope, size in zip(upstream, ctx.sizes, strict=True)
        )
        maps = Maps(*(slope.numpy() for slope in slopes))
        parts, columns = _parts(ctx.trace.ends), CHANNELS_FROM + plan.table.shape[1]
        each = len(plan.order) * columns * plan.splats.itemsize  # bytes of a thread's sums
        threads = max(min(torch.get_num_threads(), MOST_SUMS // max(each, 1)), 1)
        # Every thread has fixed tiles and its own sums, so the result does not depend on their order.
        dealt = [np.concatenate(parts[k::threads]) for k in range(min(threads, len(parts)))]
        sums = _kept.take((len(dealt), len(plan.order), columns), plan.splats.dtype)
        in_threads(backward_tiles, [(tiles, plan, maps, ctx.trace, sums[k]) for k, tiles in enumerate(dealt)])
        found = [torch.zeros_like(part) for part in (positions, conics, opacities)]
        found += [opacities.new_zeros(len(opacities), ctx.sizes[0]), torch.zeros_like(variances)]
        shapes = (part.numpy() for part in (conics, variances, opacities))
        arrays = plan, *shapes, sums, _Gradients(*(g.numpy() for g in found))
        in_threads(_collect, [(*part, *arrays) for part in ranges(len(plan.order), least=4096)])
        return found[0].view_as(means2d), *found[1:], *[None] * 3


class _Gradients(NamedTuple):
    """Gradients per Gaussian."""

    position: Float[np.ndarray, "n 2"]
    conic: Float[np.ndarray, "n 3"]
    opacity: Float[np.ndarray, " n"]
    channels: Float[np.ndarray, "n c"]
    variances: Float[np.ndarray, "n 2"]


def _parts(work: np.ndarray) -> list[np.ndarray]:
    """Split the tiles into parts of about equal work, several per thread. Empty tiles count a little, too."""
    threads = torch.get_num_threads()
    parts = PARTS_PER_THREAD * threads if threads > 1 else 1
    ends = np.cumsum(work + 8.0)
    limits = np.searchsorted(ends, np.linspace(0, ends[-1], parts + 1)[1:-1])
    return [tiles for tiles in np.split(np.arange(len(work)), limits) if len(tiles)]


@kernel
def _collect(first, last, plan, conics, variances, opacities, sums, found) -> None:
    """Collect the gradients of a range of Gaussians from the sums of all threads. With a and b the conic's xx
    and xy, ln(alpha) is ln(opacity) − (a·u² + dy² / variance) / 2, where u = dx + b / a · dy."""
    row = np.empty(sums.shape[2], sums.dtype)
    for rank in range(first, last):
        row[:] = sums[0, rank]
        for part in range(1, len(sums)):
            row += sums[part, rank]
        if not row.any():  # no pixel shows it, perhaps because its variance is 0, by which 0 would be divided
            continue
        g = plan.order[rank]
        shear, variance = plan.splats[rank, 2], variances[g, 1]
        found.conic[g, 0], found.conic[g, 1] = shear * row[1] - 0.5 * row[0], -row[1]
        found.variances[g, 1] = 0.5 * row[2] / variance / variance
        # dx and dy point from the center to the pixel.
        found.position[g, 0] = conics[g, 0] * row[3]
        found.position[g, 1] = conics[g, 1] * row[3] + row[4] / variance
        found.opacity[g] = row[5] / opacities[g]
        for k in range(found.channels.shape[1]):
            found.channels[g, k] = row[CHANNELS_FROM + k]


class Plan(NamedTuple):
    """Visible Gaussians in depth order and, for each tile, those that may touch it."""

    order: Int[np.ndarray, " v"]
    """Indices of the Gaussians, front to back."""
    splats: Float[np.ndarray, "v 6"]
    table: Float[np.ndarray, "v c"]
    """Channels, a one for alpha, and zeros up to a multiple of four."""
    starts: Int[np.ndarray, " tiles+1"]
    """First row of each tile."""
    ranks: Int[np.ndarray, " rows"]
    """Positions in the depth order, ascending within a tile."""
    width: int
    height: int


def make_plan(
    means2d: Float[Tensor, "1 n 2"],
    conics: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    channels: Float[Tensor, "n c"],
    variances: Float[Tensor, "n 2"],
    depths: Float[Tensor, " n"],
    width: int,
    height: int,
) -> Plan:
    """Find the Gaussians that reach 1/255 in some pixel, and sort them by depth and into tiles."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    positions, form, spread, opacity, values = (
        part.detach().contiguous().numpy() for part in (means2d[0], conics, variances, opacities, channels)
    )
    boxes = np.empty((len(opacities), 4), np.int32)
    visible = np.empty(len(opacities), np.int64)
    count = _find_visible(positions, spread, opacity, width, height, boxes, visible)
    seen = torch.from_numpy(visible[:count])
    order = seen.index_select(0, depth_order(depths.detach().index_select(0, seen))).numpy()

    splats = np.empty((count, SPLAT_COLUMNS), positions.dtype)
    table = np.empty((count, -(-(channels.shape[1] + 1) // UNROLL) * UNROLL), positions.dtype)
    arrays = order, positions, form, spread, opacity, values
    in_threads(_pack, [(*part, *arrays, splats, table) for part in ranges(count, least=4096)])

    sizes = np.zeros(columns * rows + 1, np.int64)
    bands = ranges(rows)
    in_threads(_count_rows, [(order, boxes, columns, *band, sizes) for band in bands])
    starts = np.cumsum(sizes)
    ranks = np.empty(starts[-1], np.int32)
    in_threads(_fill_rows, [(order, boxes, columns, *band, starts, ranks) for band in bands])
    return Plan(order, splats, table, starts, ranks, width, height)


def depth_order(depths: Float[Tensor, " v"]) -> Int[Tensor, " v"]:
    """Return indices front to back. Positive floats sort like their bits, and integers have a radix sort."""
    keys = depths.view(torch.int32) if depths.dtype == torch.float32 else depths
    return torch.sort(keys, stable=True).indices


@kernel
def _find_visible(means2d, variances, opacities, width, height, boxes, visible):
    """List the Gaussians that reach some pixel, with their ranges of tiles, and return their number."""
    count = 0
    for g in range(len(opacities)):
        opacity = opacities[g]
        if not opacity * 255.0 >= 1.0:
            continue
        bound = 2 * math.log(255.0 * opacity)
        reach_x = math.sqrt(bound * variances[g, 0]) + REACH_SLACK
        reach_y = math.sqrt(bound * variances[g, 1]) + REACH_SLACK
        x, y = means2d[g, 0] - 0.5, means2d[g, 1] - 0.5
        left, right = max(x - reach_x, 0.0), min(x + reach_x, width - 1.0)
        top, bottom = max(y - reach_y, 0.0), min(y + reach_y, height - 1.0)
        # This test also fails for NaN.
        if not (left <= right and top <= bottom):
            continue
        first_x, last_x = math.ceil(left), int(right)
        first_y, last_y = math.ceil(top), int(bottom)
        if first_x > last_x or first_y > last_y:
            continue
        boxes[g, 0], boxes[g, 1] = first_x // TILE, last_x // TILE
        boxes[g, 2], boxes[g, 3] = first_y // TILE, last_y // TILE
        visible[count] = g
        count += 1
    return count


@kernel
def _pack(first, last, order, means2d, conics, variances, opacities, channels, splats, table) -> None:
    """Gather the compositing data of a range of Gaussians, contiguous and in depth order."""
    for rank in range(first, last):
        g = order[rank]
        splats[rank, 0], splats[rank, 1] = means2d[g, 0], means2d[g, 1]
        splats[rank, 2] = conics[g, 1] / conics[g, 0]
        splats[rank, 3] = conics[g, 0] * (LOG2_E / 2)
        splats[rank, 4] = (LOG2_E / 2) / variances[g, 1]
        splats[rank, 5] = math.log2(opacities[g])
        for c in range(table.shape[1]):
            table[rank, c] = 0
        for c in range(channels.shape[1]):
            table[rank, c] = channels[g, c]
        table[rank, channels.shape[1]] = 1


@kernel
def _count_rows(order, boxes, columns, first, last, sizes) -> None:
    """Add each tile's number of Gaussians, for a range of tile rows, to the entry after its own."""
    for g in order:
        for y in range(max(boxes[g, 2], first), min(boxes[g, 3] + 1, last)):
            for x in range(boxes[g, 0], boxes[g, 1] + 1):
                sizes[y * columns + x + 1] += 1


@kernel
def _fill_rows(order, boxes, columns, first, last, starts, ranks) -> None:
    place = starts[first * columns : last * columns].copy()
    for rank in range(len(order)):
        g = order[rank]
        for y in range(max(boxes[g, 2], first), min(boxes[g, 3] + 1, last)):
            for x in range(boxes[g, 0], boxes[g, 1] + 1):
                tile = (y - first) * columns + x
                ranks[place[tile]] = rank
                place[tile] += 1
