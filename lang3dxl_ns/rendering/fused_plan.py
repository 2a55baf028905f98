"""Assignment of Gaussians to tiles, front to back, for the fused kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.common.jit import in_threads, kernel, ranges
from lang3dxl_ns.rendering.gaussians import REACH_SLACK

LOG2_E = math.log2(math.e)
TILE = 16
"""Side of a tile, pixels."""
SPLAT_COLUMNS = 6
"""Columns of a splat: x, y, shear, steepness, rise and log2 of opacity. At (dx, dy) from the center, log2 of
alpha is log2 opacity − steepness·(dx + shear·dy)² − rise·dy², which stays accurate far from the center of a
needle."""
UNROLL = 4
"""Channels composited at a time. Their number is rounded up to a multiple of this."""


class Plan(NamedTuple):
    """Visible Gaussians in depth order and, for each tile, those that may touch it."""

    order: Int[np.ndarray, " v"]
    """Indices of the Gaussians, front to back."""
    splats: Float[np.ndarray, "v 6"]
    table: Float[np.ndarray, "v c"]
    """Channels with a gradient to the geometry, a one for alpha, and zeros up to a multiple of four; then the
    detached channels, padded likewise."""
    attached: int
    """Number of columns of the table before the detached ones."""
    starts: Int[np.ndarray, " tiles+1"]
    """First row of each tile."""
    ranks: Int[np.ndarray, " rows"]
    """Positions in the depth order, ascending within a tile."""
    width: int
    height: int


def make_plan(
    means2d: Float[Tensor, "n 2"],
    conics: Float[Tensor, "n 3"],
    variances: Float[Tensor, "n 2"],
    depths: Float[Tensor, " n"],
    opacities: Float[Tensor, " n"],
    channels: Float[Tensor, "n c"],
    detached: Float[Tensor, "n d"],
    width: int,
    height: int,
) -> Plan:
    """Find the Gaussians that reach 1/255 in some pixel, and sort them by depth and into tiles."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    positions, form, spread, opacity, attached_channels, detached_channels = (
        part.detach().contiguous().numpy()
        for part in (means2d, conics, variances, opacities, channels, detached)
    )
    boxes = np.empty((len(opacities), 4), np.int32)
    visible = np.empty(len(opacities), np.int64)
    count = _find_visible(positions, spread, opacity, width, height, boxes, visible)
    seen = torch.from_numpy(visible[:count])
    order = seen.index_select(0, depth_order(depths.detach().index_select(0, seen))).numpy()

    attached = _rounded_up(channels.shape[1] + 1)
    splats = np.empty((count, SPLAT_COLUMNS), positions.dtype)
    table = np.empty((count, attached + _rounded_up(detached.shape[1])), positions.dtype)
    arrays = order, positions, form, spread, opacity, attached_channels, detached_channels, attached
    in_threads(_pack, [(*part, *arrays, splats, table) for part in ranges(count, least=4096)])

    sizes = np.zeros(columns * rows + 1, np.int64)
    bands = ranges(rows)
    in_threads(_count_rows, [(order, boxes, columns, *band, sizes) for band in bands])
    starts = np.cumsum(sizes)
    ranks = np.empty(starts[-1], np.int32)
    in_threads(_fill_rows, [(order, boxes, columns, *band, starts, ranks) for band in bands])
    return Plan(order, splats, table, attached, starts, ranks, width, height)


def depth_order(depths: Float[Tensor, " v"]) -> Int[Tensor, " v"]:
    """Return indices front to back. Positive floats sort like their bits, and integers have a radix sort."""
    keys = depths.view(torch.int32) if depths.dtype == torch.float32 else depths
    return torch.sort(keys, stable=True).indices


def _rounded_up(count: int) -> int:
    return -(-count // UNROLL) * UNROLL


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
def _pack(
    first, last, order, means2d, conics, variances, opacities, channels, detached, attached, splats, table
) -> None:
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
        for c in range(detached.shape[1]):
            table[rank, attached + c] = detached[g, c]


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
