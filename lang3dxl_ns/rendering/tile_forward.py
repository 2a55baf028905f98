"""Forward compositing of a segment's rows over the tiles, front to back.

Tiles are composited in *waves* of at most `WAVE` rows each, so that tiles whose pixels have all stopped can
be dropped early. A wave is divided into *chunks* of tiles with similar numbers of rows left, small enough for
the processor's cache. Only the transmittance at a chunk's start is kept; the backward recomputes the rest.

The arrays of a chunk are laid out depth by tile by pixel, so that the scans over depth, which are most of
the work, read and write contiguous slices.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.rendering.tile_plan import ALPHA_MIN, Rows

ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
"""A pixel stops before the Gaussian that would bring its transmittance to this or below."""

WAVE = 32
CHUNK_ELEMENTS = 1 << 19
"""Elements (tiles × rows × pixels) of one chunk's largest arrays: 2 MB in float32."""
_MIN_CHUNK_TILES = 64
_LOG2_ALPHA_MAX = math.log2(ALPHA_MAX)
# Any value below log2(1/255) works; exp2 of arguments that underflow is ten times slower.
_LOG2_ALPHA_FLOOR = -10.0


@dataclass
class Chunk:
    """Tiles composited together, and the data to repeat it in the backward pass."""

    tiles: Int[Tensor, " b"]
    first: int
    """First row of the wave, counted from each tile's start."""
    depth: int
    """Rows per tile; tiles with fewer are padded with the padding row."""
    transmittance: Float[Tensor, "b pixels"]
    """At the chunk's start; 0 where the pixel has stopped."""
    stops: bool
    """Whether some pixel has stopped at the chunk's end."""


class Scratch:
    """Buffers reused from chunk to chunk: allocating memory costs more than the arithmetic."""

    def __init__(self, like: Tensor):
        self._like = like
        self._buffers: dict[str, Tensor] = {}

    def take(self, name: str, *shape: int) -> Tensor:
        """An uninitialized tensor, valid until the next `take` of the same name."""
        size = math.prod(shape)
        buffer = self._buffers.get(name)
        if buffer is None or buffer.numel() < size:
            buffer = self._buffers[name] = self._like.new_empty(size)
        return buffer[:size].view(shape)


def composite_rows(
    rows: Rows,
    basis: Float[Tensor, "6 pixels"],
    table: Float[Tensor, "v c"],
    transmittance: Float[Tensor, "tiles pixels"],
    totals: Float[Tensor, "tiles c pixels"],
) -> list[Chunk]:
    """Composite one segment: adds weight × table to `totals` and updates `transmittance`, both in place.

    `table` holds the channels of the visible Gaussians in depth order. Returns the chunks in order of
    computation.
    """
    scratch = Scratch(table)
    chunks = []
    active = ((rows.count > 0) & (transmittance.amax(1) > 0)).nonzero().squeeze(1)
    first = 0
    while len(active):
        for tiles, depth in _cut_wave(active, rows.count.index_select(0, active) - first, basis.shape[1]):
            chunks.append(
                _composite_chunk(rows, tiles, first, depth, basis, table, transmittance, totals, scratch)
            )
        first += WAVE
        unfinished = (rows.count.index_select(0, active) > first) & (
            transmittance.index_select(0, active).amax(1) > 0
        )
        active = active[unfinished]
    return chunks


def _cut_wave(
    active: Int[Tensor, " t"], remaining: Int[Tensor, " t"], pixels: int
) -> Iterator[tuple[Int[Tensor, " b"], int]]:
    """Divide the active tiles into groups (tiles, rows per tile) of similar length and bounded size."""
    lengths, order = torch.sort(remaining.clamp_max(WAVE).int(), descending=True, stable=True)
    active = active.index_select(0, order)
    descending = lengths.neg().tolist()
    first = 0
    while first < len(descending):
        depth = min(WAVE, -(descending[first] // 4) * 4)
        most = max(1, CHUNK_ELEMENTS // (depth * pixels))
        similar = bisect_left(descending, -depth / 2, lo=first)
        last = min(first + most, max(similar, first + _MIN_CHUNK_TILES), len(descending))
        yield active[first:last], depth
        first = last


def _composite_chunk(
    rows: Rows,
    tiles: Int[Tensor, " b"],
    first: int,
    depth: int,
    basis: Float[Tensor, "6 pixels"],
    table: Float[Tensor, "v c"],
    transmittance: Float[Tensor, "tiles pixels"],
    totals: Float[Tensor, "tiles c pixels"],
    scratch: Scratch,
) -> Chunk:
    index = chunk_rows(rows, tiles, first, depth)
    before = transmittance.index_select(0, tiles)
    alpha = chunk_alpha(rows, index, basis, scratch).view(depth, len(tiles), -1)
    passing = chunk_transmittance(alpha, before, scratch)
    stops = bool(passing[-1].min() <= TRANSMITTANCE_MIN)
    weights = alpha.mul_(passing[:-1])
    if stops:
        after = F.threshold(passing[1:], TRANSMITTANCE_MIN, 0.0, inplace=True)
        weights.mul_(torch.sign(after, out=scratch.take("going", *weights.shape)))
    transmittance.index_copy_(0, tiles, passing[-1])
    values = chunk_values(rows, index, table).view(depth, len(tiles), -1).permute(1, 2, 0)
    totals.index_add_(0, tiles, torch.bmm(values, weights.transpose(0, 1)))
    return Chunk(tiles, first, depth, before, stops)


def chunk_rows(rows: Rows, tiles: Int[Tensor, " b"], first: int, depth: int) -> Int[Tensor, " depth*b"]:
    """Row numbers of a chunk, depth by depth across its tiles; the padding row beyond a tile's last."""
    step = torch.arange(first, first + depth, device=tiles.device)[:, None]
    index = rows.start.index_select(0, tiles) + step
    return index.masked_fill_(step >= rows.count.index_select(0, tiles), len(rows)).view(-1)


def chunk_values(rows: Rows, index: Int[Tensor, " m"], table: Float[Tensor, "v c"]) -> Float[Tensor, "m c"]:
    """The channels of each row's Gaussian."""
    return table.index_select(0, rows.ranks.index_select(0, index))


def chunk_alpha(
    rows: Rows, index: Int[Tensor, " m"], basis: Float[Tensor, "6 pixels"], scratch: Scratch
) -> Float[Tensor, "m pixels"]:
    """Alpha of each row in each pixel of its tile: one matrix product and one power of two."""
    coefficients = gather_coefficients(rows, index, scratch)
    alpha = torch.mm(coefficients.t(), basis, out=scratch.take("alpha", len(index), basis.shape[1]))
    alpha.clamp_(_LOG2_ALPHA_FLOOR, _LOG2_ALPHA_MAX).exp2_()
    return F.threshold(alpha, _just_below(ALPHA_MIN, alpha.dtype), 0.0, inplace=True)


def gather_coefficients(rows: Rows, index: Int[Tensor, " m"], scratch: Scratch) -> Float[Tensor, "6 m"]:
    """The polynomials of each row."""
    out = scratch.take("coefficients", len(rows.coefficients), len(index))
    for column, target in zip(rows.coefficients, out.unbind(0), strict=True):
        torch.index_select(column, 0, index, out=target)
    return out


def chunk_transmittance(
    alpha: Float[Tensor, "k b pixels"], before: Float[Tensor, "b pixels"], scratch: Scratch
) -> Float[Tensor, "k+1 b pixels"]:
    """Transmittance before each row and after the last, ignoring stops.

    Slice by slice, because `cumprod` is slower and a scan over all tiles loses digits.
    """
    depth, count, pixels = alpha.shape
    passing = scratch.take("passing", depth + 1, count, pixels)
    slices = passing.unbind(0)
    slices[0].copy_(before)
    for k, step in enumerate(alpha.unbind(0)):
        torch.addcmul(slices[k], slices[k], step, value=-1, out=slices[k + 1])
    return passing


def _just_below(value: float, dtype: torch.dtype) -> float:
    """A value for `threshold`, which keeps only what is greater, that also keeps what is equal."""
    rounded = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(rounded, torch.zeros_like(rounded)))
