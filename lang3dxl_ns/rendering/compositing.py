"""Compositing of screen ellipses on any device: entry of the differentiable torch rasterizer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from lang3dxl_ns.rendering.tile_backward import ABSOLUTE_COLUMNS, SHAPE_COLUMNS, backward_rows
from lang3dxl_ns.rendering.tile_forward import ALPHA_MAX, Chunk, composite_rows
from lang3dxl_ns.rendering.tile_plan import Rows, make_footprints, make_rows


@dataclass
class _Segment:
    """One range of the depth order, with its data for the backward pass."""

    extent: tuple[int, int]
    live: Bool[Tensor, " tiles"] | None
    chunks: list[Chunk]


def composite(
    means2d: Float[Tensor, "*one n 2"],
    conics: Float[Tensor, "n 3"],
    variances: Float[Tensor, "n 2"],
    depths: Float[Tensor, " n"],
    opacities: Float[Tensor, " n"],
    channels: Float[Tensor, "n c"],
    width: int,
    height: int,
    *,
    detached_channels: Float[Tensor, "n d"] | None = None,
    absgrad: bool = False,
    by: type[torch.autograd.Function] | None = None,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w d"], Float[Tensor, "h w 1"]]:
    """Composite screen ellipses front to back over black: image, detached image, alpha.

    Pixels, conics and variances as in `Splats`. gsplat's rules: alpha at most 0.999, skipped below 1/255;
    a pixel stops before its transmittance reaches 1e-4. The gradient of the detached image reaches only
    `detached_channels`. `absgrad`: the backward pass sets `means2d.absgrad`, the sums of the absolute pixel
    gradients. by: what computes it; default torch.
    """
    if detached_channels is None:
        detached_channels = channels.new_empty(len(channels), 0)
    return (by or Compositing).apply(
        means2d, conics, opacities, channels, detached_channels, variances, depths, width, height, absgrad
    )


class Compositing(torch.autograd.Function):
    """Composites the depth order in segments to bound memory; only the last segment's rows are kept."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        channels: Tensor,
        detached_channels: Tensor,
        variances: Tensor,
        depths: Tensor,
        width: int,
        height: int,
        absgrad: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        footprints, grid = make_footprints(
            means2d.view(-1, 2), conics, variances, depths, opacities, width, height
        )
        basis = grid.basis(channels)
        # In depth order, because tiles read Gaussians adjacent in depth at about the same time.
        seen = [part.index_select(0, footprints.gaussians) for part in (detached_channels, channels)]
        table = torch.cat([*seen, channels.new_ones(len(footprints.gaussians), 1)], dim=1)
        transmittance = table.new_ones(grid.tiles, grid.pixels)
        totals = table.new_zeros(grid.tiles, table.shape[1], grid.pixels)
        segments: list[_Segment] = []
        rows: Rows | None = None
        for extent in footprints.segments():
            live = transmittance.amax(1) > 0 if segments else None
            rows = make_rows(footprints, extent, grid, live)
            segments.append(_Segment(extent, live, composite_rows(rows, basis, table, transmittance, totals)))

        ctx.save_for_backward(means2d, conics, opacities)
        ctx.set_materialize_grads(False)
        ctx.footprints, ctx.grid, ctx.segments, ctx.last_rows = footprints, grid, segments, rows
        ctx.basis, ctx.table, ctx.absgrad = basis, table, absgrad
        ctx.sizes = (detached_channels.shape[1], channels.shape[1], 1)
        features, image, alpha = (grid.to_image(part) for part in totals.split(ctx.sizes, dim=1))
        return image, features, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, image: Tensor | None, features: Tensor | None, alpha: Tensor | None) -> Any:  # type: ignore[override]
        means2d, conics, opacities = ctx.saved_tensors
        upstream = _upstream(ctx, (features, image, alpha))
        gradient = _segment_gradients(ctx, upstream, opacities)

        order, count = ctx.footprints.gaussians, len(opacities)
        a, b, c = conics.index_select(0, order).unbind(1)
        conic, (x, y), log_opacity = gradient[:, :3], gradient[:, 3:5].unbind(1), gradient[:, 5]
        position = torch.stack([a * x + b * y, b * x + c * y], dim=1)
        rest = gradient[:, SHAPE_COLUMNS:]
        if ctx.absgrad:
            means2d.absgrad = _scatter(rest[:, :ABSOLUTE_COLUMNS], order, count).view_as(means2d)
            rest = rest[:, ABSOLUTE_COLUMNS:]
        detached, channels, _ = (_scatter(part, order, count) for part in rest.split(ctx.sizes, dim=1))
        opacity = log_opacity / opacities.index_select(0, order)
        return (
            _scatter(position, order, count).view_as(means2d),
            _scatter(conic, order, count),
            _scatter(opacity, order, count),
            channels,
            detached,
            *[None] * 5,
        )


def _upstream(ctx: Any, images: tuple[Tensor | None, ...]) -> Float[Tensor, "tiles pixels c"]:
    """The gradients of the outputs in tile layout, in the order of the table; missing ones are 0."""
    upstream = ctx.table.new_zeros(ctx.grid.tiles, ctx.grid.pixels, ctx.table.shape[1])
    for part, image in zip(upstream.split(ctx.sizes, dim=2), images, strict=True):
        if image is not None:
            part.copy_(ctx.grid.to_tiles(image))
    return upstream


def _segment_gradients(
    ctx: Any, upstream: Float[Tensor, "tiles pixels c"], opacities: Float[Tensor, " n"]
) -> Float[Tensor, "v columns"]:
    """Gradients of all segments, per visible Gaussian in depth order (columns: see `backward_rows`)."""
    behind = upstream.new_zeros(ctx.grid.tiles, ctx.grid.pixels)
    clamped = bool((opacities > ALPHA_MAX).any())
    rows = ctx.last_rows
    columns = SHAPE_COLUMNS + ABSOLUTE_COLUMNS * ctx.absgrad + sum(ctx.sizes)
    gradients = [upstream.new_zeros(0, columns)]
    for segment in reversed(ctx.segments):
        if rows is None:
            rows = make_rows(ctx.footprints, segment.extent, ctx.grid, segment.live)
        gradients.append(
            backward_rows(
                rows,
                segment.chunks,
                ctx.basis,
                ctx.table,
                upstream,
                behind,
                detached=ctx.sizes[0],
                clamped=clamped,
                absolute=ctx.absgrad,
            )
        )
        rows = None
    return torch.cat(gradients[::-1])


def _scatter(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Values placed at `index` among `count` zeros."""
    return values.new_zeros(count, *values.shape[1:]).index_copy_(0, index, values)
