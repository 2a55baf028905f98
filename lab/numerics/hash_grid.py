"""Hard cases of the hash grid."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from unittest.mock import patch

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call

from lab.numerics.measure import EXACT, Bounds, Case, Maps, Problem
from lang3dxl_ns.common.kernels import VARIABLE, numba_works
from lang3dxl_ns.components.hash_grid import COORDINATE_LIMIT, HASH_PRIMES, HashGrid

LARGE = 512.0
"""Factor by which table values exceed a new grid's, which makes them as large as after training."""


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Yield cases of coordinates, tables and number types, in torch and, on the CPU, in compiled kernels."""
    yield from _cases("hash grid", "torch")
    if device == "cpu" and numba_works():
        yield from _cases("hash grid, numba", "numba")


def _cases(component: str, kernels: str) -> Iterator[Case]:
    bounds = {"float32": Bounds(2e-4, 5e-5, 1e-3, 2e-4), "float64": EXACT}
    catalog: dict[str, tuple[Callable[[], Tensor], str]] = {
        "uniform in [0, 1]": (_uniform, ""),
        "exactly 0 and 1": (lambda: _uniform().round(), ""),
        "cell borders": (_borders, ""),
        "outside, up to ±1000": (lambda: 2000 * _uniform() - 1000, ""),
        "huge: ±1e4, 1e30, ∞": (_huge, "clamped to ±1024"),
        "NaN": (_with_nan, "NaN in its own row, nowhere else"),
    }
    for name, (points, note) in catalog.items():
        constants = frozenset({"table"}) if name == "NaN" else frozenset[str]()
        yield Case(component, name, partial(_problem, points, kernels, constants=constants), bounds, note)
    yield Case(component, "four dimensions", partial(_problem, lambda: _uniform(4), kernels), bounds)
    few = partial(_problem, _uniform, kernels, log2_table=3)
    yield Case(component, "collisions: 8 entries a level", few, bounds)
    if kernels == "numba":  # these kernels support float32 and float64 only
        return
    yield Case(
        component,
        "level 2048, table in bf16",
        partial(_problem, _uniform, kernels, table_type=torch.bfloat16),
        {"float32": Bounds(2e-2, 1e-2, 5e-2, 1e-2)},
        "coordinates stay in float32: in bf16 the finest level would have no fractions left",
    )
    yield Case(
        component,
        "level 2048, coordinates in bf16",
        partial(_problem, lambda: _uniform().bfloat16().double(), kernels, coordinate_type=torch.bfloat16),
        {"float32": Bounds(2e-4, 5e-5, 1e-2, 5e-3)},
        "the coordinate's gradient is rounded to bf16",
    )


def _uniform(dimensions: int = 3) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(200, dimensions, generator=generator, dtype=torch.float64)


def _borders() -> Tensor:
    """Compute vertices of every level; they are exact in any type, since cells are powers of two."""
    cells = 2.0 ** torch.arange(4, 12, dtype=torch.float64).repeat_interleave(24)[:, None]
    vertex = (_uniform()[: len(cells)] * (cells - 1)).floor()
    return (vertex + 0.5) / cells


def _huge() -> Tensor:
    points = _uniform()
    points[:10], points[10:20], points[20:30], points[30] = 1e4, -1e4, 1e30, math.inf
    return points


def _with_nan() -> Tensor:
    points = _uniform()
    points[3], points[7, 1] = math.nan, math.nan
    return points


def _problem(
    points: Callable[[], Tensor],
    kernels: str,
    log2_table: int = 14,
    table_type: torch.dtype | None = None,
    coordinate_type: torch.dtype | None = None,
    constants: frozenset[str] = frozenset(),
) -> Problem:
    x = points()
    # The levels grow by exactly 2, from 16 + 2 to 2048 + 2 vertices, so that cells are powers of two.
    grid = HashGrid(x.shape[1], 8, 4, log2_table, 18, 2050, generator=torch.Generator().manual_seed(0))
    cells = 2.0 ** torch.arange(4, 12)
    grid.cells.copy_(cells)
    grid.dense_resolutions.copy_((cells[: grid.dense_levels] + 2).long())
    table = LARGE * grid.table.detach().double()
    if table_type is not None:
        table = table.to(table_type).double()

    def compute(leaves: Maps) -> Maps:
        used = leaves["table"] if table_type is None else leaves["table"].to(table_type)
        coordinates = leaves["x"] if coordinate_type is None else leaves["x"].to(coordinate_type)
        with patch.dict(os.environ, {VARIABLE: kernels}):
            return {"features": functional_call(grid.to(used.device), {"table": used}, (coordinates,))}

    def reference(leaves: Maps) -> Maps:
        return {"features": interpolate_reference(grid, leaves["table"], leaves["x"])}

    return Problem({"x": x, "table": table}, compute, reference, constants=constants)


def interpolate_reference(
    grid: HashGrid, table: Float[Tensor, "entries f"], x: Float[Tensor, "n d"]
) -> Float[Tensor, "n out"]:
    """Interpolate a hash grid level by level and corner by corner; autograd gives the gradients."""
    x = x.clamp(-COORDINATE_LIMIT, COORDINATE_LIMIT)
    capacity, offset, levels = grid.hash_mask + 1, 0, []
    for cells in grid.cells.tolist():
        resolution = int(cells) + 2
        dense = resolution**grid.input_dim <= capacity
        position = x * cells + 0.5
        lower = position.detach().floor()
        fraction, lower = position - lower, lower.nan_to_num().long()
        features = torch.zeros(len(x), table.shape[1]).to(table)
        for corner in product((0, 1), repeat=grid.input_dim):
            entry, weight = torch.zeros_like(lower[:, 0]), torch.ones_like(x[:, 0])
            for axis, side in enumerate(corner):
                vertex = lower[:, axis] + side
                weight = weight * (fraction[:, axis] if side else 1 - fraction[:, axis])
                if dense:
                    entry = entry + vertex.remainder(resolution) * resolution**axis
                else:
                    entry = entry ^ (vertex * HASH_PRIMES[axis] & 0xFFFFFFFF)
            features = features + weight[:, None] * table[offset + entry.remainder(capacity)]
        levels.append(features)
        offset += min(-(-(resolution**grid.input_dim) // 8) * 8, capacity)
    return torch.stack(levels, 1).flatten(1)
