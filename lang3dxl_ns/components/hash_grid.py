"""Multi-resolution hash grid in plain torch, for spaces of two to six dimensions.

Every level has a regular lattice over the unit cube, with one feature vector per vertex in a table of bounded
size: levels that fit are stored densely, finer ones share entries through a hash. A point reads the 2^d
vertices of its cell on every level, interpolates linearly, and concatenates the levels (Müller et al.,
Instant Neural Graphics Primitives, 2022).
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lang3dxl_ns.common.kernels import takes_kernels

HASH_PRIMES = (1, 2654435761, 805459861, 3674653429, 2097192037, 1434869437)
MOST_DIMENSIONS = len(HASH_PRIMES)
INITIAL_RANGE = 1e-4
COORDINATE_LIMIT = 1024.0
"""Bound ± to which coordinates are clamped; float32 still resolves an eighth of a cell 1/2048 wide there."""

_WIDEST_ROW_OF_KERNELS = 8
"""Longest table entry for the kernels; torch adds up longer ones faster, entry by entry in vectors."""


class HashGrid(nn.Module):
    """Trainable features over [0, 1]^d, differentiable in the table and in the coordinates (first order).

    A level of resolution r has r vertices per axis, and [0, 1] spans r - 2 cells, from half a cell inside the
    lattice on either side. So neither 0 nor 1 reads past the table or lies on a vertex. Outside [0, 1] the
    lattice continues with entries already in use (dense levels repeat, hashed levels hash). Any coordinate
    gives finite features, and has a gradient up to ± 1024, where it is clamped. A NaN coordinate makes only
    its own output row NaN.

    Args:
        input_dim: number of dimensions d, 2 to 6.
        levels: number of resolutions, in geometric progression from `min_resolution` to `max_resolution`;
            0 makes a grid without features.
        features_per_level: length of an entry.
        log2_table_size: log2 of the maximum number of entries per level.
        min_resolution, max_resolution: vertices per axis of the coarsest and the finest level.
        generator: source of the uniform ± 1e-4 initial values.
    """

    def __init__(
        self,
        input_dim: int,
        levels: int,
        features_per_level: int,
        log2_table_size: int,
        min_resolution: int,
        max_resolution: int,
        *,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        if not 2 <= input_dim <= MOST_DIMENSIONS:
            raise ValueError(f"input_dim must be 2 to {MOST_DIMENSIONS}, got {input_dim}")
        if levels < 0 or not 3 <= log2_table_size <= 30 or not 3 <= min_resolution <= max_resolution:
            raise ValueError(
                "needs levels ≥ 0, 3 ≤ log2_table_size ≤ 30, 3 ≤ min_resolution ≤ max_resolution; got "
                f"{levels}, {log2_table_size}, {min_resolution}, {max_resolution}"
            )
        self.input_dim, self.levels, self.features_per_level = input_dim, levels, features_per_level
        self.output_dim = levels * features_per_level

        growth = (max_resolution / min_resolution) ** (1 / max(levels - 1, 1))
        # Without rounding first, rounding error could make the finest level one vertex wider.
        resolutions = [math.ceil(round(min_resolution * growth**level, 6)) for level in range(levels)]
        capacity = 2**log2_table_size
        sizes = [min(-(-(r**input_dim) // 8) * 8, capacity) for r in resolutions]  # multiples of 8
        self.entries = sum(sizes)
        self.dense_levels = sum(r**input_dim <= capacity for r in resolutions)
        self.hash_mask = capacity - 1

        table = torch.empty(self.entries, features_per_level)
        self.table = nn.Parameter(table.uniform_(-INITIAL_RANGE, INITIAL_RANGE, generator=generator))
        self.cells: Tensor  # per unit, two fewer than vertices per axis
        self.offsets: Tensor  # the first table row of each level
        self.dense_resolutions: Tensor
        offsets = [sum(sizes[:level]) for level in range(levels)]
        # They are integers, so that `.half()` and the like don't round them.
        self.register_buffer("cells", torch.tensor([r - 2 for r in resolutions]), persistent=False)
        self.register_buffer("offsets", torch.tensor(offsets), persistent=False)
        dense = torch.tensor(resolutions[: self.dense_levels], dtype=torch.int64)
        self.register_buffer("dense_resolutions", dense, persistent=False)

    def forward(self, x: Float[Tensor, "n d"]) -> Float[Tensor, "n out"]:
        """Interpolate the features of every point, in the table's number type. Coordinates are computed in at
        least float32, because in 16 bits a fine level would have no fractions left."""
        if not self.levels:
            return x.new_zeros(len(x), 0)
        exact = torch.promote_types(self.table.dtype, torch.float32)
        x = x.to(exact).clamp(-COORDINATE_LIMIT, COORDINATE_LIMIT)
        narrow = self.features_per_level <= _WIDEST_ROW_OF_KERNELS
        if narrow and takes_kernels(x) and x.dtype == self.table.dtype:
            return self._interpolated_by_kernels(x)
        # Whole units are separate integers: far from 0, a float32 product has no digits left for a fraction.
        whole = x.detach().floor()
        position = (x - whole).T[:, None] * self.cells[:, None] + 0.5
        lower = position.detach().floor()
        rows = self._vertex_entries(lower.long() + whole.long().T[:, None] * self.cells[:, None])
        weights = _corner_weights(position - lower)
        # Points vary fastest in what was computed so far, which suits elementwise work; corners do in bags.
        bags = [part.permute(2, 1, 0).reshape(-1, len(rows)) for part in (rows, weights.to(self.table.dtype))]
        features = F.embedding_bag(bags[0], self.table, per_sample_weights=bags[1], mode="sum")
        return features.view(len(x), self.output_dim)

    def _interpolated_by_kernels(self, x: Float[Tensor, "n d"]) -> Float[Tensor, "n out"]:
        from lang3dxl_ns.components.fused_hash_grid import Lattices, interpolate  # numba is slow to import

        primes = torch.tensor(HASH_PRIMES[: self.input_dim])
        buffers = [values.numpy() for values in (self.cells, self.offsets, primes)]
        lattices = Lattices(buffers[0], buffers[1], self.dense_levels, self.hash_mask, buffers[2])
        return interpolate(x.contiguous(), self.table.contiguous(), lattices)

    def _vertex_entries(self, lower: Int[Tensor, "d levels n"]) -> Int[Tensor, "corners levels n"]:
        """Compute the table rows of the corners of each point's cell; the last axis varies fastest. Any
        integer is a valid vertex, even one that NaN was converted to."""
        vertices = torch.stack((lower, lower + 1), 1)
        dense, hashed = vertices[:, :, : self.dense_levels], vertices[:, :, self.dense_levels :]
        dense = dense % self.dense_resolutions[:, None]
        # The mask keeps the low bits, which are the same in a 64-bit product as in the usual 32-bit one.
        keys = [axis * prime & self.hash_mask for axis, prime in zip(hashed, HASH_PRIMES, strict=False)]
        dense_entry, hashed_entry = dense[0], keys[0]
        for axis in range(1, self.input_dim):
            stride = self.dense_resolutions[:, None] ** axis
            dense_entry = (dense_entry[:, None] + dense[axis] * stride).flatten(0, 1)
            hashed_entry = (hashed_entry[:, None] ^ keys[axis]).flatten(0, 1)
        # 32 bits suffice for a row number, and halve what is read.
        return (torch.cat((dense_entry, hashed_entry), 1) + self.offsets[:, None]).int()


def _corner_weights(fraction: Float[Tensor, "d levels n"]) -> Float[Tensor, "corners levels n"]:
    """Multiply the axes' weights for all corners of a cell, in the order of `_vertex_entries`."""
    first, *others = torch.stack((1 - fraction, fraction), 1)
    for sides in others:
        first = (first[:, None] * sides).flatten(0, 1)
    return first
