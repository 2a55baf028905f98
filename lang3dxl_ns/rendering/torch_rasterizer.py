"""Compositing in plain torch, for machines without compiled kernels: any device, float32 or float64.

A *row* is a pair of tile and Gaussian. A *chunk* holds the next rows of some tiles, few enough to compute all
their pixels at once. Autograd differentiates one chunk at a time, computed again in the backward pass, so
memory is bounded by a chunk and the list of rows.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from lang3dxl_ns.rendering.gaussians import ALPHA_MAX, ALPHA_MIN, REACH_SLACK, TRANSMITTANCE_MIN

TILE = 8
"""Pixels per side of a tile."""
ROWS_AT_A_TIME = 1 << 20
"""Rows made at a time. The limit is needed because Gaussians close to the camera cover every tile."""
DEPTH = 32
"""Rows per tile and chunk. Tiles whose pixels have all stopped are left out of the next chunk."""
TILES = {"cpu": 64}
"""Tiles per chunk by device: on the CPU, an array of all their pixels takes 512 kB, which fits its cache."""
MOST_TILES = 4096
"""Tiles per chunk on other devices, which need large chunks: an array of all their pixels takes 32 MB."""


class Compositing(torch.autograd.Function):
    """Compositing of screen ellipses front to back over black, to image and alpha, [h, w, …] each. The rules
    are gsplat's: alpha is at most 0.999 and skipped below 1/255, and a pixel stops before its transmittance
    reaches 1e-4."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        channels: Tensor,
        variances: Tensor,
        depths: Tensor,
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor]:
        parts = (means2d[0], conics[:, :2], variances[:, 1:], opacities[:, None], channels)
        boxes, order = _visible(means2d[0], variances, depths, opacities, width, height)
        # In depth order, with a transparent Gaussian at the end, which pads tiles with fewer rows.
        table = F.pad(torch.cat([part[order] for part in parts], dim=1), (0, 1, 0, 1))
        table[:-1, -1] = 1  # accumulates alpha
        table[-1, 2:5] = 1
        columns, tiles = -(-width // TILE), -(-width // TILE) * -(-height // TILE)
        sizes = channels.shape[1], 1
        maps = table.new_zeros(tiles, TILE * TILE, sum(sizes))
        passing = table.new_ones(tiles, TILE * TILE)
        chunks = []
        for chunk in _chunks(boxes, passing, columns):
            found, behind = _composite(table[chunk.ranks], chunk, columns)
            maps[chunk.tiles] += found
            passing[chunk.tiles] = behind
            chunks.append(chunk)
        ctx.save_for_backward(means2d, table, order)
        ctx.set_materialize_grads(False)
        ctx.chunks, ctx.columns, ctx.size = chunks, columns, (height, width)
        ctx.sizes, ctx.widths = sizes, [part.shape[1] for part in parts]
        image = maps.view(-1, columns, TILE, TILE, sum(sizes)).transpose(1, 2).flatten(2, 3).flatten(0, 1)
        image, alpha = (part.contiguous() for part in image[:height, :width].split(sizes, dim=2))
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, image: Tensor | None, alpha: Tensor | None) -> Any:  # type: ignore[override]
        means2d, table, order = ctx.saved_tensors
        upstream = _in_tiles((image, alpha), ctx.sizes, table, ctx.columns, ctx.size)
        g_table, g_passing = torch.zeros_like(table), table.new_zeros(upstream.shape[:2])
        for chunk in reversed(ctx.chunks):
            rows = table[chunk.ranks].requires_grad_()
            chunk = chunk._replace(before=chunk.before.detach().requires_grad_())
            with torch.enable_grad():
                found = _composite(rows, chunk, ctx.columns)
            slopes = upstream[chunk.tiles], g_passing[chunk.tiles]
            g_rows, g_before = torch.autograd.grad(found, (rows, chunk.before), slopes)
            g_passing[chunk.tiles] = g_before
            g_table.index_add_(0, chunk.ranks.view(-1), g_rows.flatten(0, 1))

        def scattered(values: Tensor) -> Tensor:
            return values.new_zeros(means2d.shape[1], values.shape[1]).index_copy_(0, order, values[:-1])

        gradients = (scattered(part) for part in g_table[:, :-1].split(ctx.widths, dim=1))
        means, conics, variances, opacities, channels = gradients
        conics, variances = F.pad(conics, (0, 1)), F.pad(variances, (1, 0))  # unused by `forward`
        return means[None], conics, opacities[:, 0], channels, variances, *[None] * 3


class _Chunk(NamedTuple):
    """The next rows of some tiles."""

    tiles: Int[Tensor, " b"]
    ranks: Int[Tensor, "b k"]
    """Rows of the table that each tile composites, front to back."""
    before: Float[Tensor, "b pixels"]
    """Transmittance in front of the rows; 0 where the pixel has stopped."""


def _composite(
    rows: Float[Tensor, "b k columns"], chunk: _Chunk, columns: int
) -> tuple[Float[Tensor, "b pixels c"], Float[Tensor, "b pixels"]]:
    """Composite a chunk onto its tiles' maps, and return what it adds and the transmittance behind it. The
    quadratic form is steepness·(dx + shear·dy)² + dy²/variance. Unlike the conic itself, it stays accurate in
    float32 far from the center of a needle."""
    x, y, a, b, variance, opacity = rows[..., :6, None].unbind(2)
    pixel = torch.arange(TILE * TILE, device=rows.device)
    dx = (chunk.tiles % columns * TILE)[:, None, None] + pixel % TILE + 0.5 - x
    dy = (chunk.tiles // columns * TILE)[:, None, None] + pixel // TILE + 0.5 - y
    form = a * (dx + b / a * dy).square() + dy.square() / variance
    alpha = opacity * torch.exp(-0.5 * form)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha.clamp_max(ALPHA_MAX), 0.0)
    after = chunk.before[:, None] * torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([chunk.before[:, None], after[:, :-1]], dim=1)
    weights = torch.where(after > TRANSMITTANCE_MIN, alpha * before, 0.0).mT
    after = torch.where(after[:, -1] > TRANSMITTANCE_MIN, after[:, -1], 0.0)
    return weights @ rows[..., 6:], after


def _visible(
    means2d: Float[Tensor, "n 2"],
    variances: Float[Tensor, "n 2"],
    depths: Float[Tensor, " n"],
    opacities: Float[Tensor, " n"],
    width: int,
    height: int,
) -> tuple[Int[Tensor, "v 4"], Int[Tensor, " v"]]:
    """Find the tiles that each visible Gaussian may reach (first column and row, last column and row), and
    the indices of these Gaussians, front to back."""
    # Alpha falls to 1/255 where the quadratic form equals this; −inf at opacity 0 and NaN both fail the test.
    bound = 2 * torch.log(opacities / ALPHA_MIN)
    reach = (bound.clamp_min(0)[:, None] * variances).sqrt() + REACH_SLACK
    size = torch.tensor([width, height], device=means2d.device)
    first = (means2d - reach - 0.5).ceil().clamp_min(0).minimum(size)
    last = (means2d + reach - 0.5).floor().clamp_min(-1).minimum(size - 1)
    visible = ((bound >= 0) & (first <= last).all(1)).nonzero().squeeze(1)
    order = visible[torch.sort(depths[visible], stable=True).indices]
    return torch.cat([first, last], dim=1)[order].long() // TILE, order


def _chunks(
    boxes: Int[Tensor, "v 4"], passing: Float[Tensor, "tiles pixels"], columns: int
) -> Iterator[_Chunk]:
    """Yield all rows front to back. The caller writes the transmittance behind each chunk to `passing`."""
    ends = torch.cumsum((boxes[:, 2:] - boxes[:, :2] + 1).prod(1), 0).tolist()
    first = 0
    while first < len(ends):
        last = max(first + 1, bisect_right(ends, ROWS_AT_A_TIME + (ends[first - 1] if first else 0)))
        ranks, count = _rows(boxes[first:last], passing.amax(1) > 0, columns)
        if len(ranks):
            yield from _cut(F.pad(ranks + first, (0, 1), value=len(boxes)).int(), count, passing)
        first = last


def _rows(
    boxes: Int[Tensor, "v 4"], live: Bool[Tensor, " tiles"], columns: int
) -> tuple[Int[Tensor, " r"], Int[Tensor, " tiles"]]:
    """List the Gaussians in each live tile, tile by tile and front to back, and count them per tile."""
    wide, high = (boxes[:, 2:] - boxes[:, :2] + 1).unbind(1)
    area = wide * high
    ranks = torch.repeat_interleave(area)
    index = torch.arange(len(ranks), device=boxes.device) - (torch.cumsum(area, 0) - area)[ranks]
    row = torch.div(index, wide[ranks], rounding_mode="floor")
    tiles = (boxes[ranks, 1] + row) * columns + boxes[ranks, 0] + index - row * wide[ranks]
    kept = live[tiles].nonzero().squeeze(1)
    tiles, order = torch.sort(tiles[kept], stable=True)
    return ranks[kept[order]], torch.bincount(tiles, minlength=len(live))


def _cut(
    ranks: Int[Tensor, " r+1"], count: Int[Tensor, " tiles"], passing: Float[Tensor, "tiles pixels"]
) -> Iterator[_Chunk]:
    """Yield chunks of tiles with similar numbers of rows. The last of `ranks` pads the shorter ones."""
    start = torch.cumsum(count, 0) - count
    count, tiles = torch.sort(count, descending=True)
    start, at_a_time = start[tiles], TILES.get(ranks.device.type, MOST_TILES)
    for first in range(0, int(count[0]), DEPTH):
        going = ((count > first) & (passing[tiles].amax(1) > 0)).nonzero().squeeze(1)
        for some in going.split(at_a_time) if len(going) else ():
            step = torch.arange(first, min(first + DEPTH, int(count[some[0]])), device=ranks.device)
            index = torch.where(step < count[some, None], start[some, None] + step, len(ranks) - 1)
            yield _Chunk(tiles[some], ranks[index], passing[tiles[some]])


def _in_tiles(
    maps: tuple[Tensor | None, ...], sizes: tuple[int, ...], like: Tensor, columns: int, size: tuple[int, int]
) -> Float[Tensor, "tiles pixels c"]:
    """Arrange maps as tiles, with 0 outside the image and for a missing map."""
    height, width = size
    found = like.new_zeros(-(-height // TILE) * TILE, columns * TILE, sum(sizes))
    for part, given in zip(found.split(sizes, dim=2), maps, strict=True):
        if given is not None:
            part[:height, :width] = given
    return found.view(-1, TILE, columns, TILE, sum(sizes)).transpose(1, 2).reshape(-1, TILE**2, sum(sizes))
