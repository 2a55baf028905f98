"""The fast path: the decoder tabulated over the part of the code space that a scene's renderings reach.

The decoder is a function of a code's few numbers. Its unit features at the vertices of the reached cells,
times a text's vector, are a scalar per vertex; a pixel is then one interpolated read. Cosines are
interpolated, not relevancies: the maximum over competing phrases has kinks, which interpolation would blur.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lang3dxl_ns.memory import with_less_memory
from lang3dxl_ns.query.relevancy import TEMPERATURE, Decode, Queries, cosines_of_codes

_ROWS_AT_ONCE = 1 << 16
"""Vertices that are decoded, or converted from half precision, at a time."""
_MOST_DIMENSIONS = 4
_CHECKED_CODES = 50_000
_EDGE = 1e-6
"""Bounded coordinates keep this distance from 0 and 1, whose codes are infinite."""


@dataclass
class LookupConfig:
    """Settings of the fast path."""

    sizes: tuple[int, ...] = (64, 128)
    """Cells per axis, tried in turn until a table is good enough; none left: every code is decoded."""
    tolerance: float = 0.03
    """Largest error of relevancy: of a table that is used (99.9th percentile, against exact decodes), and in
    the middle of a cell, or the codes of that cell are decoded."""
    most_decoded: float = 0.1
    """A table that leaves more of the codes than this to be decoded is too coarse."""
    max_mb: float = 512.0
    """A table that would need more memory is not built."""


@dataclass(frozen=True)
class TableError:
    """How a table's relevancies differ from exact ones."""

    mean: float
    p999: float
    """99.9th percentile."""
    flips: float
    """Share that lies on the other side of 0.5."""


@dataclass(frozen=True)
class TableCheck:
    """A table that was built, and how well it did."""

    size: int
    vertices: int
    megabytes: float
    seconds: float
    """To build it."""
    decoded: float
    """Share of the codes that lie in cells which it leaves to be decoded."""
    error: TableError
    """With those decoded."""


class CodeTable:
    """Unit features at the vertices of the reached cells of a grid over the code space.

    `bounded`: the grid is regular in sigmoid(code), where the field's own grid is, and not in the code.
    """

    def __init__(
        self,
        size: int,
        bounded: bool,
        low: Float[Tensor, " d"],
        extent: Float[Tensor, " d"],
        cell_of: Int[Tensor, " cells"],
        corners: Int[Tensor, "reached 2**d"],
        features: Float[Tensor, "vertices c"],
    ) -> None:
        self.size, self.bounded = size, bounded
        self.low, self.extent = low, extent
        self.cell_of, self.corners, self.features = cell_of, corners, features
        self._strides = torch.tensor([size**axis for axis in range(len(low))], device=low.device).flip(0)
        self._last: tuple[Tensor, Tensor] | None = None

    @property
    def megabytes(self) -> float:
        """Memory of all parts."""
        return sum(t.numel() * t.element_size() for t in (self.cell_of, self.corners, self.features)) / 2**20

    @torch.no_grad()
    def cosines(self, vectors: Float[Tensor, "v c"]) -> Float[Tensor, "vertices v"]:
        """Cosines of every vertex to unit vectors; those of the last call are kept, since many views are
        asked the same."""
        last = self._last  # another thread may ask something else meanwhile
        if last is None or not torch.equal(last[0], vectors):
            parts = [part.to(vectors.dtype) @ vectors.T for part in self.features.split(_ROWS_AT_ONCE)]
            last = self._last = vectors.clone(), torch.cat(parts)
        return last[1]

    @torch.no_grad()
    def leave_out_rough_cells(
        self, decode: Decode, probes: Queries, tolerance: float, temperature: float = TEMPERATURE
    ) -> None:
        """Forget the cells in whose middle the relevancy to any of the probes is off by more than
        `tolerance`: where the decoder bends too sharply, its codes are decoded."""
        cells = (self.cell_of >= 0).nonzero()
        middles = self.low + (cells // self._strides % self.size + 0.5) * (self.extent / self.size)
        if self.bounded:
            middles = middles.clamp(_EDGE, 1 - _EDGE).logit()
        cosines = self.cosines(probes.vectors)
        for part, codes in zip(cells[:, 0].split(_ROWS_AT_ONCE), middles.split(_ROWS_AT_ONCE), strict=True):
            exact = probes.relevancy_of_cosines(cosines_of_codes(decode, codes, probes), temperature)
            read = probes.relevancy_of_cosines(self.read(codes, cosines)[0], temperature)
            self.cell_of[part[(exact - read).abs().amax(0) > tolerance]] = -1

    def locate(
        self, codes: Float[Tensor, "n d"]
    ) -> tuple[Int[Tensor, " n"], Float[Tensor, "n d"], Bool[Tensor, " n"]]:
        """Reached cell of every code, place in it (0…1), and whether there is one; elsewhere cell 0."""
        place = (self._coordinates(codes) - self.low) * (self.size / self.extent)
        inside = ((place >= 0) & (place <= self.size)).all(1)
        corner = place.floor().clamp(0, self.size - 1)
        flat = (corner.nan_to_num().long() * self._strides).sum(1)
        cell = self.cell_of[flat]
        return cell.clamp_min(0), place - corner, inside & (cell >= 0)

    def read(
        self, codes: Float[Tensor, "n d"], cosines: Float[Tensor, "vertices v"]
    ) -> tuple[Float[Tensor, "n v"], Bool[Tensor, " n"]]:
        """Cosines interpolated at codes, and for which of them the table knows anything."""
        cell, place, known = self.locate(codes)
        weights = torch.ones_like(place[:, :1])
        for t in place.split(1, dim=1):
            weights = torch.stack([weights * (1 - t), weights * t], dim=2).flatten(1)
        rows = self.corners[cell]
        # One fused gather and weighted sum.
        return F.embedding_bag(rows, cosines, mode="sum", per_sample_weights=weights.to(cosines)), known

    def _coordinates(self, codes: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
        return codes.sigmoid() if self.bounded else codes


@dataclass(frozen=True)
class Grid:
    """The reached cells of a grid over the code space, and their vertices."""

    size: int
    bounded: bool
    low: Float[Tensor, " d"]
    extent: Float[Tensor, " d"]
    cell_of: Int[Tensor, " cells"]
    """Number of every cell among the reached ones, −1 for the others."""
    corners: Int[Tensor, "reached 2**d"]
    """Rows of their vertices."""
    vertices: Float[Tensor, "vertices d"]
    """Codes there."""


def mark_cells(codes: Float[Tensor, "n d"], size: int, bounded: bool) -> Grid:
    """The cells that `codes` reach, and their neighbours.

    codes: those of rendered views, without pixels that show nothing (their one code is an isolated spike).
    size: cells per axis of the codes' bounding box, widened by 1 %.
    """
    dims, device = codes.shape[1], codes.device
    coordinates = codes.sigmoid() if bounded else codes
    low, high = coordinates.amin(0), coordinates.amax(0)
    # A coordinate that never changes needs a box all the same.
    margin = (0.01 * (high - low)).clamp_min(1e-4)
    low, extent = low - margin, high - low + 2 * margin
    cells = ((coordinates - low) * (size / extent)).floor().long().clamp_(0, size - 1)
    reached = _dilated(_occupancy(cells, size)).nonzero()
    cell_of = torch.full((size,) * dims, -1, dtype=torch.int32, device=device)
    cell_of[tuple(reached.T)] = torch.arange(len(reached), dtype=torch.int32, device=device)
    steps = torch.tensor(list(product((0, 1), repeat=dims)), device=device)
    strides = (size + 1) ** torch.arange(dims - 1, -1, -1, device=device)
    flat, corners = ((reached[:, None] + steps) * strides).sum(2).unique(return_inverse=True)
    place = flat[:, None].div(strides, rounding_mode="floor").remainder(size + 1)
    vertices = low + place * (extent / size)
    if bounded:
        vertices = vertices.clamp(_EDGE, 1 - _EDGE).logit()
    return Grid(size, bounded, low, extent, cell_of.flatten(), corners.int(), vertices)


@torch.no_grad()
def tabulate(decode: Decode, grid: Grid) -> CodeTable:
    """The decoder at the grid's vertices."""
    features = with_less_memory(
        lambda rows: [F.normalize(decode(part), dim=-1).half() for part in grid.vertices.split(rows)],
        _ROWS_AT_ONCE,
    )
    places = grid.size, grid.bounded, grid.low, grid.extent, grid.cell_of, grid.corners
    return CodeTable(*places, torch.cat(features))


def _occupancy(cells: Int[Tensor, "n d"], size: int) -> Bool[Tensor, "..."]:
    occupied = torch.zeros((size,) * cells.shape[1], dtype=torch.bool, device=cells.device)
    occupied[tuple(cells.T)] = True
    return occupied


def _dilated(occupied: Bool[Tensor, "..."]) -> Bool[Tensor, "..."]:
    """Occupied cells and their neighbours along every axis and diagonal."""
    for axis in range(occupied.ndim):
        before, after = (
            occupied.narrow(axis, 0, occupied.shape[axis] - 1),
            occupied.narrow(axis, 1, occupied.shape[axis] - 1),
        )
        wider = occupied.clone()
        wider.narrow(axis, 1, occupied.shape[axis] - 1).logical_or_(before)
        wider.narrow(axis, 0, occupied.shape[axis] - 1).logical_or_(after)
        occupied = wider
    return occupied


# ── is it good enough? ──────────────────────────────────────────────────────────────────────────────────


def table_error(exact: Float[Tensor, "q n"], approximate: Float[Tensor, "q n"]) -> TableError:
    """Mean and 99.9th percentile of the difference of relevancies, and the share of 0.5 crossed."""
    difference = (exact - approximate).abs().flatten()
    # quantile() takes 16 million values at most; kthvalue takes any number.
    k = max(int(0.999 * difference.numel()), 1)
    flips = (exact > 0.5) != (approximate > 0.5)
    return TableError(
        float(difference.mean()), float(difference.kthvalue(k).values), float(flips.double().mean())
    )


class Lookup:
    """The chosen table, if one is good enough, and what was tried."""

    def __init__(self, table: CodeTable | None, checks: Sequence[TableCheck]) -> None:
        self.table = table
        self.checks = list(checks)

    @classmethod
    def build(
        cls,
        decode: Decode,
        codes: Float[Tensor, "n d"],
        probes: Queries,
        bounded: bool,
        config: LookupConfig,
        temperature: float = TEMPERATURE,
    ) -> Lookup:
        """Try the configured sizes in turn; each is checked against exact decodes of a sample of the codes.

        probes: prompts of the kind that people will ask, whose relevancies are compared. Codes of more
        numbers than a grid can hold have no table.
        """
        checks: list[TableCheck] = []
        codes = codes[codes.isfinite().all(1)]  # one that is not would leave the box without bounds
        if not len(codes) or codes.shape[1] > _MOST_DIMENSIONS:
            return cls(None, checks)
        sample = codes[_random_rows(len(codes), _CHECKED_CODES).to(codes.device)]
        exact = probes.relevancy_of_cosines(cosines_of_codes(decode, sample, probes), temperature)
        for size in config.sizes:
            start = time.perf_counter()
            grid = mark_cells(codes, size, bounded)
            if len(grid.vertices) * probes.vectors.shape[1] * 2 / 2**20 > config.max_mb:
                break
            table = tabulate(decode, grid)
            table.leave_out_rough_cells(decode, probes, config.tolerance, temperature)
            seconds = time.perf_counter() - start
            decoded = 1 - float(table.locate(sample)[2].float().mean())
            error = table_error(exact, CodeScorer(decode, table, temperature).relevancy(sample, probes))
            checks.append(TableCheck(size, len(table.features), table.megabytes, seconds, decoded, error))
            if error.p999 <= config.tolerance and decoded <= config.most_decoded:
                return cls(table, checks)
        return cls(None, checks)

    def __str__(self) -> str:
        lines = [
            f"{c.size} cells per axis, {c.vertices} vertices, {c.megabytes:.0f} MB, {c.seconds:.1f} s; "
            f"error of relevancy {c.error.mean:.4f} on average, {c.error.p999:.4f} at the 99.9th percentile, "
            f"{c.error.flips:.2%} across 0.5, {c.decoded:.2%} left to be decoded"
            for c in self.checks
        ]
        return "; ".join(lines if self.table else [*lines, "no table is good enough: every code is decoded"])

    def description(self) -> list[dict]:
        """The checks as plain values."""
        return [asdict(check) for check in self.checks]


def _random_rows(count: int, wanted: int) -> Int[Tensor, " n"]:
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))[:wanted]


# ── reading ─────────────────────────────────────────────────────────────────────────────────────────────


class CodeScorer:
    """Relevancy of codes, through the table where it knows them and by decoding elsewhere.

    Args:
        decode: `SemanticField.decode_clip`.
        table: None: everything is decoded.
        max_mb: memory of the decoded features at any time, about.
    """

    def __init__(
        self,
        decode: Decode,
        table: CodeTable | None = None,
        temperature: float = TEMPERATURE,
        max_mb: float = 256.0,
    ) -> None:
        self.decode, self.table, self.temperature, self.max_mb = decode, table, temperature, max_mb

    @torch.no_grad()
    def relevancy(
        self,
        codes: Float[Tensor, "... d"],
        queries: Queries,
        keep: Bool[Tensor, "..."] | None = None,
    ) -> Float[Tensor, "q ..."]:
        """Relevancy of every code; 0 where `keep` is false (nothing is seen there)."""
        shape = codes.shape[:-1]
        flat = codes.reshape(-1, codes.shape[-1])
        chosen = slice(None) if keep is None else keep.flatten().nonzero()[:, 0]
        scores = flat.new_zeros(len(queries), len(flat))
        cosines = self.cosines(flat[chosen], queries)
        scores[:, chosen] = queries.relevancy_of_cosines(cosines, self.temperature)
        return scores.reshape(len(queries), *shape)

    @torch.no_grad()
    def cosines(self, codes: Float[Tensor, "n d"], queries: Queries) -> Float[Tensor, "n v"]:
        """Cosine of every code's feature to every vector."""
        if not len(codes):
            return codes.new_zeros(0, len(queries.vectors))
        if self.table is None:
            return self._exact(codes, queries)
        cosines, known = self.table.read(codes, self.table.cosines(queries.vectors))
        if not bool(known.all()):
            cosines[~known] = self._exact(codes[~known], queries)
        return cosines

    def _exact(self, codes: Float[Tensor, "n d"], queries: Queries) -> Float[Tensor, "n v"]:
        return cosines_of_codes(self.decode, codes, queries, self.max_mb)
