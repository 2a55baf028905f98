"""Hard cases of the table of decoded codes: whatever the codes, it gives what decoding them gives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from lang3dxl_ns.components.semantic_field import SemanticField, SemanticFieldConfig
from lang3dxl_ns.evaluation.numerics.decoder import decode_reference
from lang3dxl_ns.evaluation.numerics.measure import Bounds, Case, Maps, Problem
from lang3dxl_ns.evaluation.numerics.relevancy import CHANNELS, relevancy_reference
from lang3dxl_ns.query.lookup import CodeScorer, CodeTable, Lookup, LookupConfig, mark_cells, tabulate
from lang3dxl_ns.query.relevancy import Queries

READING = {"float32": Bounds(1e-5, 2e-6), "float64": Bounds(1e-9, 1e-9)}
TABLE = {mode: Bounds(0.06, 0.03) for mode in ("float32", "float64")}
EXACT_DECODES = {"float32": Bounds(1e-4, 2e-5), "float64": Bounds(1e-9, 1e-9)}


def cases(quick: bool, device: str) -> Iterator[Case]:
    """The interpolated read on its own, and relevancy through the table against exact decodes."""
    spread = {
        "usual": _codes,
        "all codes equal": lambda: _codes()[:1].expand(300, 3).clone(),
        "one channel constant": lambda: _codes().index_fill(1, torch.tensor(1), 0.5),
        "codes ±50": lambda: 50 * _codes().sign(),
    }
    for name, codes in spread.items():
        for bounded in (True, False):
            case = f"reading, {name}{'' if bounded else ', unbounded'}"
            yield Case("lookup", case, partial(_reading, codes, bounded), READING)
    note = "the table's own error: at most the tolerance of 0.03 in the middle of a cell"
    for name, codes in spread.items():
        yield Case("lookup", name, partial(_relevancy, codes), TABLE, note)
    elsewhere: dict[str, Callable[[], Tensor]] = {
        "codes that the table does not know": lambda: _codes() + 3,
        "codes ±1e4 and ±∞": lambda: torch.cat([1e4 * _codes(), math.inf * _codes().sign()]),
        "NaN in some codes": lambda: _codes().index_fill(0, torch.tensor([3, 8]), math.nan),
        "no code": lambda: _codes()[:0],
    }
    for name, asked in elsewhere.items():
        bounds = TABLE if "NaN" in name else EXACT_DECODES
        note = "decoded, not read" if bounds is EXACT_DECODES else "NaN in its own pixel, nowhere else"
        yield Case("lookup", name, partial(_relevancy, _codes, asked), bounds, note)
    note = "a NaN among the rendered codes does not spoil the table"
    spoilt = elsewhere["NaN in some codes"]
    yield Case("lookup", "NaN while building", partial(_relevancy, spoilt, _codes), TABLE, note)


def _codes() -> Tensor:
    """Three clusters, as surfaces of a kind make them."""
    generator = torch.Generator().manual_seed(0)
    centres = 2 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    return centres.repeat(100, 1) + 0.1 * torch.randn(300, 3, generator=generator, dtype=torch.float64)


def _field(bounded: bool = True) -> tuple[SemanticField, Maps]:
    """A decoder, its loud table as after training, and its parameters in float64."""
    config = SemanticFieldConfig(preset="short", bounding="sigmoid" if bounded else "raw")
    field = SemanticField(config, CHANNELS, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        field.grid.table.mul_(300)
    return field, {name: value.detach().double() for name, value in field.named_parameters()}


def _queries() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    vectors = torch.randn(7, CHANNELS, generator=generator, dtype=torch.float64)
    return vectors[:3], vectors[3:]


def _relevancy(codes: Callable[[], Tensor], asked: Callable[[], Tensor] | None = None) -> Problem:
    """Relevancy of codes through a table made of others; the table is built in every run that is timed."""
    field, state = _field()
    queries, canonical = _queries()
    probes = Queries.of(queries[:, None].unbind(), canonical)

    def compute(given: Maps) -> Maps:
        dtype, device = given["asked"].dtype, given["asked"].device
        moved = field.to(device, dtype)
        mine = Queries(probes.vectors.to(device, dtype), probes.positive, probes.negative)
        lookup = Lookup.build(moved.decode_clip, given["codes"], mine, True, LookupConfig(sizes=(32, 64)))
        scorer = CodeScorer(moved.decode_clip, lookup.table)
        return {"relevancy": scorer.relevancy(given["asked"], mine), "table": _flag(lookup.table is not None)}

    def reference(given: Maps) -> Maps:
        device = given["asked"].device
        exact = decode_reference(field.double(), {**_on(state, device), "codes": given["asked"]})["clip"]
        scores = relevancy_reference(exact, queries.to(device), canonical.to(device), 10.0)
        return {"relevancy": scores, "table": _flag(True)}

    leaves = {"codes": codes(), "asked": (asked or codes)()}
    return Problem(leaves, compute, reference, constants=frozenset(leaves))


def _reading(codes: Callable[[], Tensor], bounded: bool) -> Problem:
    """A table's interpolated cosines against the same table read corner by corner."""
    field, _ = _field(bounded)
    vectors = F.normalize(torch.cat(_queries()), dim=1)
    table = tabulate(field.decode_clip, mark_cells(codes().float(), 16, bounded))
    cosines = table.features.double() @ vectors.T

    def compute(given: Maps) -> Maps:
        here = given["codes"]
        read, known = _moved(table, here).read(here, cosines.to(here))
        return {"cosines": read, "known": known.to(here)}

    def reference(given: Maps) -> Maps:
        read = read_reference(_moved(table, given["codes"]), given["codes"], cosines.to(given["codes"]))
        return {"cosines": read, "known": torch.ones_like(read[:, 0])}

    return Problem({"codes": codes()}, compute, reference, constants=frozenset({"codes"}))


def _moved(table: CodeTable, like: Tensor) -> CodeTable:
    places = table.low.to(like), table.extent.to(like)
    indices = (part.to(like.device) for part in (table.cell_of, table.corners, table.features))
    return CodeTable(table.size, table.bounded, *places, *indices)


def read_reference(table: CodeTable, codes: Tensor, cosines: Tensor) -> Tensor:
    """Linear interpolation between the corners of each code's cell, one code after another."""
    rows = []
    for coordinate in codes.sigmoid() if table.bounded else codes:
        place = (coordinate - table.low) / table.extent * table.size
        corner = place.floor().clamp(0, table.size - 1)
        flat = 0
        for axis in corner.long().tolist():
            flat = flat * table.size + axis
        total = torch.zeros_like(cosines[0])
        for row, sides in zip(
            table.corners[int(table.cell_of[flat])].tolist(), product((0, 1), repeat=len(place)), strict=True
        ):
            weight = math.prod(
                float(t if side else 1 - t) for t, side in zip(place - corner, sides, strict=True)
            )
            total = total + weight * cosines[row]
        rows.append(total)
    return torch.stack(rows)


def _flag(value: bool) -> Tensor:
    return torch.tensor([float(value)], dtype=torch.float64)


def _on(state: Maps, device: torch.device) -> Maps:
    return {name: value.to(device) for name, value in state.items()}
