"""Hash-grid interpolation and its gradients in one compiled pass over points, levels and corners.

The torch operations of `hash_grid` keep rows and weights of all corners in memory, and sort them to add up
the table's gradient. Here each is computed where it is used, in the forward and again in the backward pass.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray as Array
from torch import Tensor
from torch.autograd.function import once_differentiable

from lang3dxl_ns.common.jit import in_threads, kernel, ranges

_POINTS = 1024
"""Smallest number of points per thread."""


class Lattices(NamedTuple):
    """Levels of a grid, in the form that the kernels take: `HashGrid`'s attributes of the same names."""

    cells: Int[Array, " levels"]
    offsets: Int[Array, " levels"]
    dense_levels: int
    hash_mask: int
    primes: Int[Array, " d"]


def interpolate(
    x: Float[Tensor, "n d"], table: Float[Tensor, "entries f"], lattices: Lattices
) -> Float[Tensor, "n out"]:
    """Interpolate the features of points like `HashGrid.forward`; differentiable in points and table, which
    must be on the CPU and of one number type, float32 or float64."""
    return _Interpolate.apply(x, table, lattices)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, table: Tensor, lattices: Lattices) -> Tensor:  # type: ignore[override]
        ctx.arrays = x.numpy(), table.numpy()
        ctx.lattices = lattices
        features = x.new_empty(len(x), len(lattices.cells) * table.shape[1])
        shared = (*ctx.arrays, lattices, features.numpy())
        in_threads(_features, [(*part, *shared) for part in ranges(len(x), _POINTS)])
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> Any:  # type: ignore[override]
        x, table = ctx.arrays
        grad, levels = upstream.contiguous().numpy(), len(ctx.lattices.cells)
        grad_table = np.zeros_like(table)
        # Each thread has a range of levels, so no two of them add to the same rows.
        shared = (*ctx.arrays, ctx.lattices, grad, grad_table, ctx.needs_input_grad[0])
        parts = in_threads(_gradients, [(*part, *shared) for part in ranges(levels)])
        grad_x = sum(parts) if parts else np.zeros_like(x)
        moved = torch.from_numpy(grad_x) if ctx.needs_input_grad[0] else None
        return moved, torch.from_numpy(grad_table), None


@numba.njit(forceinline=True)
def _look_up(point, level, lattices, entries, sides):
    """Compute the table rows of a cell's corners, and the weights of its two sides along every axis. Bit k of
    a corner's number is its side along axis k."""
    count, stride, one = lattices.cells[level], 1, sides.dtype.type(1)
    resolution = count + 2
    entries[0] = 0
    for axis in range(len(point)):
        whole = np.floor(point[axis])  # kept separate, as in `HashGrid.forward`
        position = (point[axis] - whole) * sides.dtype.type(count) + sides.dtype.type(0.5)
        lower = np.floor(position)
        sides[axis, 0], sides[axis, 1] = one - (position - lower), position - lower
        vertex = np.int64(lower) + np.int64(whole) * count
        bit = 1 << axis
        if level < lattices.dense_levels:
            low, high = vertex % resolution * stride, (vertex + 1) % resolution * stride
            stride *= resolution
            for corner in range(bit):
                entries[corner + bit] = entries[corner] + high
                entries[corner] += low
        else:
            low = vertex * lattices.primes[axis] & lattices.hash_mask
            high = (vertex + 1) * lattices.primes[axis] & lattices.hash_mask
            for corner in range(bit):
                entries[corner + bit] = entries[corner] ^ high
                entries[corner] ^= low
    for corner in range(1 << len(point)):
        entries[corner] += lattices.offsets[level]


@numba.njit(forceinline=True)
def _weight(sides, corner):
    weight = sides[0, corner & 1]
    for axis in range(1, len(sides)):
        weight *= sides[axis, corner >> axis & 1]
    return weight


@kernel
def _features(first, last, x, table, lattices, features):
    dimensions, width = x.shape[1], table.shape[1]
    entries, sides = np.empty(1 << dimensions, np.int64), np.empty((dimensions, 2), x.dtype)
    for n in range(first, last):
        if np.isnan(x[n].sum()):
            features[n] = np.nan
            continue
        for level in range(len(lattices.cells)):
            _look_up(x[n], level, lattices, entries, sides)
            found = features[n, level * width : (level + 1) * width]
            found[:] = 0
            for corner in range(1 << dimensions):
                weight = _weight(sides, corner)
                row = table[entries[corner]]
                for f in range(width):
                    found[f] += weight * row[f]


@kernel
def _gradients(first, last, x, table, lattices, grad, grad_table, of_points):
    """Add to the table's gradient, and return the part of the points' gradient that comes from these levels.
    The latter is two thirds of the work, and 0 unless `of_points`."""
    dimensions, width = x.shape[1], table.shape[1]
    entries, sides = np.empty(1 << dimensions, np.int64), np.empty((dimensions, 2), x.dtype)
    grad_x = np.zeros_like(x)
    for n in range(len(x)):
        if np.isnan(x[n].sum()):
            grad_x[n] = np.nan
            continue
        for level in range(first, last):
            _look_up(x[n], level, lattices, entries, sides)
            above = grad[n, level * width : (level + 1) * width]
            scale = x.dtype.type(lattices.cells[level])
            for corner in range(1 << dimensions):
                weight = _weight(sides, corner)
                row, grad_row = table[entries[corner]], grad_table[entries[corner]]
                product = x.dtype.type(0)
                for f in range(width):
                    grad_row[f] += weight * above[f]
                if not of_points:
                    continue
                for f in range(width):
                    product += above[f] * row[f]
                for axis in range(dimensions):
                    slope = product * scale
                    for other in range(dimensions):
                        if other != axis:
                            slope *= sides[other, corner >> other & 1]
                    grad_x[n, axis] += slope if corner >> axis & 1 else -slope
    return grad_x
