"""Backward pass of compositing: the forward's chunks in reverse order, recomputed.

With transmittance T, alpha a, weight w = a·T and v = Σ channel × upstream, a row's gradient with respect to
ln(a) in a pixel is w·v − S·a/(1−a) = w·(v − S/T'), where S sums w·v over everything behind it and T' is the
transmittance there. The channel of ones, which accumulates alpha, also covers the light that passes all
Gaussians, without a separate term.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.rendering.tile_forward import (
    ALPHA_MAX,
    TRANSMITTANCE_MIN,
    Chunk,
    Scratch,
    chunk_alpha,
    chunk_rows,
    chunk_transmittance,
    chunk_values,
    gather_coefficients,
)
from lang3dxl_ns.rendering.tile_plan import LOG2_E, Rows

SHAPE_COLUMNS = 6
"""Gradients per row: conic xx, xy, yy; first moments x, y; ln opacity."""
ABSOLUTE_COLUMNS = 2
"""Sums of the absolute pixel gradients of the screen position, x and y."""


def backward_rows(
    rows: Rows,
    chunks: list[Chunk],
    basis: Float[Tensor, "6 pixels"],
    table: Float[Tensor, "v c"],
    upstream: Float[Tensor, "tiles pixels c"],
    behind: Float[Tensor, "tiles pixels"],
    *,
    detached: int,
    clamped: bool,
    absolute: bool,
) -> Float[Tensor, "v columns"]:
    """Gradients of one segment, per Gaussian in depth order.

    Columns: the six of the shape, two absolute ones if requested, one per channel. `behind` is S of the
    segments behind this one, updated in place. The first `detached` channels have no gradient to the shape.
    `clamped`: some opacity exceeds ALPHA_MAX, so that alpha may be clamped.
    """
    extra = ABSOLUTE_COLUMNS if absolute else 0
    height = sum(len(chunk.tiles) * chunk.depth for chunk in chunks)
    gradient = table.new_empty(height + 1, SHAPE_COLUMNS + extra + table.shape[1])
    gradient[height] = 0
    place = torch.full((len(rows) + 1,), height, device=table.device)
    scratch = Scratch(table)
    for chunk in reversed(chunks):
        index = chunk_rows(rows, chunk.tiles, chunk.first, chunk.depth)
        height -= len(index)
        target = gradient[height : height + len(index)]
        place[index] = torch.arange(height, height + len(index), device=table.device)
        slope = _chunk_slope(
            rows, chunk, index, basis, table, upstream, behind, target[:, SHAPE_COLUMNS + extra :], scratch,
            detached=detached, clamped=clamped,
        )  # fmt: skip
        _store_shape(rows, index, slope, basis, target)
        if absolute:
            _store_absolute(rows, index, slope, basis, target[:, SHAPE_COLUMNS:], scratch)
    return F.embedding_bag(place[rows.by_gaussian], gradient, rows.group_start, mode="sum")


def _chunk_slope(
    rows: Rows,
    chunk: Chunk,
    index: Int[Tensor, " m"],
    basis: Float[Tensor, "6 pixels"],
    table: Float[Tensor, "v c"],
    upstream: Float[Tensor, "tiles pixels c"],
    behind: Float[Tensor, "tiles pixels"],
    channel_gradient: Float[Tensor, "m c"],
    scratch: Scratch,
    *,
    detached: int,
    clamped: bool,
) -> Float[Tensor, "m pixels"]:
    """Gradient with respect to ln(alpha) in every pixel; also stores the channels' gradient."""
    shape = (chunk.depth, len(chunk.tiles), basis.shape[1])
    alpha = chunk_alpha(rows, index, basis, scratch).view(shape)
    passing = chunk_transmittance(alpha, chunk.transmittance, scratch)
    if clamped:
        free = torch.sub(alpha.new_tensor(ALPHA_MAX), alpha, out=scratch.take("free", *shape)).sign_()
    weights = alpha.mul_(passing[:-1])
    after = passing[1:]
    if chunk.stops:
        F.threshold(after, TRANSMITTANCE_MIN, 0.0, inplace=True)
        weights.mul_(torch.sign(after, out=scratch.take("going", *shape)))
        after.clamp_min_(torch.finfo(after.dtype).tiny)  # 0/0 below; nothing is behind a stopped pixel

    here = upstream.index_select(0, chunk.tiles).transpose(1, 2)
    channel_gradient.view(*shape[:2], -1).copy_(torch.bmm(here, weights.permute(1, 2, 0)).permute(2, 0, 1))
    values = chunk_values(rows, index, table).view(*shape[:2], -1).transpose(0, 1)
    value = scratch.take("value", shape[1], shape[0], shape[2])
    torch.bmm(values[..., detached:], here[:, detached:], out=value)
    weighted = torch.mul(value.transpose(0, 1), weights, out=scratch.take("weighted", *shape))
    hidden = _suffix_sums(weighted, chunk.tiles, behind, out=value.view(shape)).div_(after)
    slope = torch.addcmul(weighted, weights, hidden, value=-1, out=weighted)
    if clamped:
        slope.mul_(free)
    return slope.view(len(index), -1)


def _suffix_sums(
    weighted: Float[Tensor, "k b pixels"],
    tiles: Int[Tensor, " b"],
    behind: Float[Tensor, "tiles pixels"],
    out: Float[Tensor, "k b pixels"],
) -> Float[Tensor, "k b pixels"]:
    """For each row the sum over the rows behind it; `behind` is passed on to the next chunk in front.

    Summed from the back, since the total minus a prefix sum loses digits behind nearly opaque Gaussians.
    """
    sums, steps = out.unbind(0), weighted.unbind(0)
    sums[-1].copy_(behind.index_select(0, tiles))
    for k in range(len(steps) - 1, 0, -1):
        torch.add(sums[k], steps[k], out=sums[k - 1])
    behind.index_copy_(0, tiles, sums[0] + steps[0])
    return out


def _store_shape(
    rows: Rows,
    index: Int[Tensor, " m"],
    slope: Float[Tensor, "m pixels"],
    basis: Float[Tensor, "6 pixels"],
    target: Float[Tensor, "m columns"],
) -> None:
    """Moments of the slope around the Gaussian's center, with the factors of the conic's gradient."""
    total, sum_x, sum_y, sum_xx, sum_xy, sum_yy = torch.mm(basis, slope.t()).unbind(0)
    x, y = rows.offset_x.index_select(0, index), rows.offset_y.index_select(0, index)
    first_x, first_y = torch.addcmul(sum_x, total, x, value=-1), torch.addcmul(sum_y, total, y, value=-1)
    columns = target[:, :SHAPE_COLUMNS].unbind(1)
    columns[0].copy_(torch.addcmul(sum_xx, sum_x.add_(first_x), x, value=-1).mul_(-0.5))
    columns[1].copy_(torch.mul(sum_y, x).addcmul_(first_x, y).sub_(sum_xy))
    columns[2].copy_(torch.addcmul(sum_yy, sum_y.add_(first_y), y, value=-1).mul_(-0.5))
    columns[3].copy_(first_x)
    columns[4].copy_(first_y)
    columns[5].copy_(total)


def _store_absolute(
    rows: Rows,
    index: Int[Tensor, " m"],
    slope: Float[Tensor, "m pixels"],
    basis: Float[Tensor, "6 pixels"],
    target: Float[Tensor, "m columns"],
    scratch: Scratch,
) -> None:
    """Sum over pixels of |d loss / d screen position| (AbsGS, Ye et al. 2024)."""
    _, x, y, xx, xy, yy = gather_coefficients(rows, index, scratch).unbind(0)
    size = slope.abs_()
    for axis, polynomial in enumerate(([x, 2 * xx, xy], [y, xy, 2 * yy])):
        steepness = torch.mm(torch.stack(polynomial, dim=1), basis[:3]).abs_()
        target[:, axis].copy_(torch.linalg.vecdot(size, steepness).div_(LOG2_E))
