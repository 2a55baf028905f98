"""Tile plan: rows of (tile, Gaussian) pairs, front to back, for compositing. No gradients here.

A *row* is one (tile, Gaussian) pair. Rows are kept as separate one-dimensional columns, because gathering
those is several times cheaper than gathering rows of a matrix.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

LOG2_E = math.log2(math.e)
ALPHA_MIN = 1 / 255
"""Alpha below which a Gaussian is skipped in a pixel."""

SMALL_SPLAT_PIXELS = 5
"""Up to this median reach, smaller tiles are faster (measured: up to 30 %)."""
ROWS_PER_SEGMENT = 1 << 20
"""Rows expanded at a time; bounds the memory when Gaussians near the camera cover every tile."""
# Pixel ranges and the cull test are widened by this much, so that rounding never drops a visible pair.
_SLACK = 1e-3


@dataclass(frozen=True)
class TileGrid:
    """The image divided into tiles, and conversion between the two layouts."""

    width: int
    height: int
    tile_width: int
    tile_height: int

    @property
    def columns(self) -> int:
        return -(-self.width // self.tile_width)

    @property
    def rows(self) -> int:
        return -(-self.height // self.tile_height)

    @property
    def tiles(self) -> int:
        return self.columns * self.rows

    @property
    def pixels(self) -> int:
        """Pixels per tile."""
        return self.tile_width * self.tile_height

    def basis(self, like: Tensor) -> Float[Tensor, "6 pixels"]:
        """1, x, y, x², xy, y² at a tile's pixel centers, in pixels from the tile's center."""
        x = torch.arange(self.tile_width, dtype=like.dtype, device=like.device) - (self.tile_width - 1) / 2
        y = torch.arange(self.tile_height, dtype=like.dtype, device=like.device) - (self.tile_height - 1) / 2
        x, y = x.repeat(self.tile_height), y.repeat_interleave(self.tile_width)
        return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])

    def to_image(self, tiles: Float[Tensor, "tiles c pixels"]) -> Float[Tensor, "h w c"]:
        channels = tiles.shape[1]
        grid = tiles.view(self.rows, self.columns, channels, self.tile_height, self.tile_width)
        image = grid.permute(0, 3, 1, 4, 2).reshape(
            self.rows * self.tile_height, self.columns * self.tile_width, channels
        )
        return image[: self.height, : self.width].contiguous()

    def to_tiles(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "tiles pixels c"]:
        """Pixels outside the image are 0."""
        channels = image.shape[2]
        right = self.columns * self.tile_width - self.width
        below = self.rows * self.tile_height - self.height
        if right or below:
            image = torch.nn.functional.pad(image, (0, 0, 0, right, 0, below))
        grid = image.view(self.rows, self.tile_height, self.columns, self.tile_width, channels)
        return grid.transpose(1, 2).reshape(self.tiles, self.pixels, channels)


@dataclass
class Footprints:
    """The potentially visible Gaussians, front to back, each with its conic and its range of tiles.

    The quadratic form is kept as steepness·(dx + shear·dy)² + rise·dy²: unlike the conic itself this stays
    accurate in float32 far from the center of a needle.
    """

    gaussians: Int[Tensor, " v"]
    """Indices of the Gaussians."""
    x: Float[Tensor, " v"]
    y: Float[Tensor, " v"]
    steepness: Float[Tensor, " v"]
    shear: Float[Tensor, " v"]
    rise: Float[Tensor, " v"]
    log2_opacity: Float[Tensor, " v"]
    first_column: Float[Tensor, " v"]
    """Leftmost tile; a float, like everything computed from it."""
    first_row: Float[Tensor, " v"]
    columns: Float[Tensor, " v"]
    """Number of tiles along x."""
    tiles: Int[Tensor, " v"]
    """Number of tiles in the range."""

    def segments(self, budget: int = ROWS_PER_SEGMENT) -> Iterator[tuple[int, int]]:
        """Divide the depth order into ranges of at most `budget` rows (but at least one Gaussian)."""
        ends = torch.cumsum(self.tiles, 0)
        first, count = 0, len(ends)
        while first < count:
            limit = budget + (int(ends[first - 1]) if first else 0)
            last = max(first + 1, int(torch.searchsorted(ends, limit, right=True)))
            yield first, last
            first = last


@dataclass
class Rows:
    """The rows of one segment, sorted by tile and front to back within a tile; one padding row at the end."""

    ranks: Int[Tensor, " r+1"]
    """Positions of the Gaussians in the depth order; the padding row has that of a visible one."""
    coefficients: tuple[Tensor, ...]
    """Six columns: log2 of alpha as a polynomial over the tile's basis."""
    offset_x: Float[Tensor, " r+1"]
    """Center of the Gaussian from the center of the tile, pixels."""
    offset_y: Float[Tensor, " r+1"]
    start: Int[Tensor, " tiles"]
    count: Int[Tensor, " tiles"]
    by_gaussian: Int[Tensor, " r"]
    """Row numbers grouped by the segment's Gaussians …"""
    group_start: Int[Tensor, " v"]
    """… and where each Gaussian's group starts in that list."""

    def __len__(self) -> int:
        return len(self.by_gaussian)


def make_footprints(
    means2d: Float[Tensor, "n 2"],
    conics: Float[Tensor, "n 3"],
    variances: Float[Tensor, "n 2"],
    depths: Float[Tensor, " n"],
    opacities: Float[Tensor, " n"],
    width: int,
    height: int,
) -> tuple[Footprints, TileGrid]:
    """Find the Gaussians that may reach 1/255 in some pixel, sort them by depth, choose the tile size."""
    x, y = (column.contiguous() for column in means2d.unbind(1))
    # Alpha falls to 1/255 where the quadratic form equals this; −inf at opacity 0 and NaN both fail the test.
    bound = 2 * torch.log(255 * opacities)
    reach = (bound.clamp_min(0)[:, None] * variances).sqrt() + _SLACK
    reach_x, reach_y = reach.unbind(1)
    left, right = _pixel_range(x, reach_x, width)
    top, bottom = _pixel_range(y, reach_y, height)
    seen = (bound >= 0) & (left <= right) & (top <= bottom)
    visible = seen.nonzero().squeeze(1)
    order = visible.index_select(0, depth_order(depths.index_select(0, visible)))

    grid = _choose_grid(width, height, torch.maximum(reach_x, reach_y).index_select(0, order))
    first_column, columns = _tile_range(left, right, grid.tile_width, order)
    first_row, rows = _tile_range(top, bottom, grid.tile_height, order)
    a, b, _ = (column.index_select(0, order) for column in conics.unbind(1))
    footprints = Footprints(
        gaussians=order,
        x=x.index_select(0, order),
        y=y.index_select(0, order),
        steepness=a,
        shear=b / a,
        rise=variances[:, 1].index_select(0, order).reciprocal_(),
        log2_opacity=opacities.index_select(0, order).log2_(),
        first_column=first_column,
        first_row=first_row,
        columns=columns,
        tiles=(columns * rows).long(),
    )
    return footprints, grid


def _pixel_range(center: Tensor, reach: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """First and last pixel whose center is within reach; if none is, the last is less than the first."""
    first = (center - reach - 0.5).ceil_().clamp_(0, size)
    last = (center + reach - 0.5).floor_().clamp_(-1, size - 1)
    return first, last


def _tile_range(first: Tensor, last: Tensor, tile: int, order: Tensor) -> tuple[Tensor, Tensor]:
    """First tile and number of tiles, in depth order."""
    first_tile = (first.index_select(0, order) / tile).floor_()
    return first_tile, (last.index_select(0, order) / tile).floor_() - first_tile + 1


def depth_order(depths: Float[Tensor, " v"]) -> Int[Tensor, " v"]:
    """Indices front to back. Positive floats sort like their bits, and integers have a radix sort."""
    keys = depths.view(torch.int32) if depths.dtype == torch.float32 else depths
    return torch.sort(keys, stable=True).indices


def _choose_grid(width: int, height: int, reach: Float[Tensor, " v"]) -> TileGrid:
    small = len(reach) > 0 and float(reach.median()) <= SMALL_SPLAT_PIXELS
    return TileGrid(width, height, 8, 4 if small else 8)


def make_rows(
    footprints: Footprints, segment: tuple[int, int], grid: TileGrid, live: Bool[Tensor, " tiles"] | None
) -> Rows:
    """Expand the footprints of one segment to rows, drop those that stay below 1/255, sort by tile.

    `live`: restrict to these tiles (None: all).
    """
    parts = {name: column[segment[0] : segment[1]] for name, column in vars(footprints).items()}
    slots, columns, rows = _expand(
        parts["tiles"], parts["first_column"], parts["first_row"], parts["columns"]
    )
    names = ("x", "y", "steepness", "shear", "rise", "log2_opacity")
    x, y, *shape = (parts[name].index_select(0, slots) for name in names)
    x = x.sub_(columns * grid.tile_width + grid.tile_width / 2)
    y = y.sub_(rows * grid.tile_height + grid.tile_height / 2)
    tiles = rows.mul_(grid.columns).add_(columns)
    keep = _touches(grid, x, y, *shape)
    if live is not None:
        keep &= live.index_select(0, tiles.int())
    kept = keep.nonzero().squeeze(1)

    tiles = tiles.index_select(0, kept).to(torch.int16 if grid.tiles < 1 << 15 else torch.int32)
    by_tile = torch.sort(tiles, stable=True).indices
    count = torch.bincount(tiles.int(), minlength=grid.tiles)
    slots = slots.index_select(0, kept)
    group_size = torch.bincount(slots, minlength=segment[1] - segment[0])
    sorted_kept = kept.index_select(0, by_tile)
    x, y, *shape = (_padded(column, sorted_kept) for column in (x, y, *shape))
    return Rows(
        ranks=_padded(slots, by_tile).add_(segment[0]),
        coefficients=_coefficients(x, y, *shape),
        offset_x=x,
        offset_y=y,
        start=torch.cumsum(count, 0) - count,
        count=count,
        by_gaussian=_inverse(by_tile),
        group_start=torch.cumsum(group_size, 0) - group_size,
    )


def _expand(
    tiles: Int[Tensor, " v"],
    first_column: Float[Tensor, " v"],
    first_row: Float[Tensor, " v"],
    width: Float[Tensor, " v"],
) -> tuple[Int[Tensor, " r"], Float[Tensor, " r"], Float[Tensor, " r"]]:
    """For every tile of every range: Gaussian, tile column, tile row."""
    starts = torch.cumsum(tiles, 0) - tiles
    slots = torch.repeat_interleave(tiles)
    index = torch.arange(len(slots), device=tiles.device) - starts.index_select(0, slots)
    local = index.to(width.dtype)  # exact: a range has far less than 2²⁴ tiles
    width = width.index_select(0, slots)
    row = ((local + 0.5) / width).floor_()
    column = local.sub_(row * width).add_(first_column.index_select(0, slots))
    return slots, column, row.add_(first_row.index_select(0, slots))


def _touches(
    grid: TileGrid,
    x: Tensor,
    y: Tensor,
    steepness: Tensor,
    shear: Tensor,
    rise: Tensor,
    log2_opacity: Tensor,
) -> Bool[Tensor, " r"]:
    """Whether the Gaussian at (x, y) from the tile's center reaches 1/255 on the tile's rectangle of pixels.

    The minimum of a convex form over a rectangle that doesn't contain the form's minimum lies on one of the
    two edges facing it; on an edge it is the one-dimensional minimum, clamped.
    """
    edge_x, edge_y = (grid.tile_width - 1) / 2, (grid.tile_height - 1) / 2
    near_x, near_y = x.clamp(-edge_x, edge_x).sub_(x), y.clamp(-edge_y, edge_y).sub_(y)
    low_x, high_x, low_y, high_y = -edge_x - x, edge_x - x, -edge_y - y, edge_y - y
    lean = steepness * shear
    lean = lean.div_(torch.addcmul(rise, lean, shear)).neg_().mul_(near_x)
    along_y = torch.clamp(lean, low_y, high_y)
    along_x = torch.clamp((shear * near_y).neg_(), low_x, high_x)
    on_side = _form(near_x, along_y, steepness, shear, rise)
    on_end = _form(along_x, near_y, steepness, shear, rise)
    return torch.minimum(on_side, on_end) <= log2_opacity * (2 / LOG2_E) + (2 * math.log(255) + _SLACK)


def _form(dx: Tensor, dy: Tensor, steepness: Tensor, shear: Tensor, rise: Tensor) -> Tensor:
    """The quadratic form at a displacement."""
    return torch.addcmul(dx, shear, dy).square_().mul_(steepness).add_(dy.square() * rise)


def _padded(column: Tensor, index: Int[Tensor, " r"]) -> Tensor:
    """The selected entries and one padding entry, 0."""
    out = column.new_zeros(len(index) + 1)
    torch.index_select(column, 0, index, out=out[:-1])
    return out


def _coefficients(
    x: Tensor, y: Tensor, steepness: Tensor, shear: Tensor, rise: Tensor, log2_opacity: Tensor
) -> tuple[Tensor, ...]:
    """log2 of alpha around the tile's center, as a polynomial; the padding row gets alpha 0."""
    steepness, rise = steepness * LOG2_E, rise * LOG2_E
    slope = torch.addcmul(x, shear, y).mul_(steepness)
    lean = steepness * shear
    constant = log2_opacity - (slope.square() / steepness + rise * y * y).mul_(0.5)
    constant[-1] = -math.inf
    return (
        constant,
        slope,
        torch.addcmul(rise * y, shear, slope),
        steepness * -0.5,
        -lean,
        torch.addcmul(rise, lean, shear).mul_(-0.5),
    )


def _inverse(permutation: Int[Tensor, " r"]) -> Int[Tensor, " r"]:
    inverse = torch.empty_like(permutation)
    inverse[permutation] = torch.arange(len(permutation), device=permutation.device)
    return inverse
