"""Numba kernels that composite tiles, forward and backward, in vectors of 16 pixels.

A tile of 16 × 16 pixels is divided into 16 blocks of 8 × 2, one vector each. Front to back, each Gaussian is
composited into those blocks of its tile that it reaches and that have not stopped. Rows are pairs of tile and
Gaussian (see `fused_compositing.Plan`). They are processed in waves of 32.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Int

from lang3dxl_ns.common.jit import kernel
from lang3dxl_ns.rendering.gaussians import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from lang3dxl_ns.rendering.simd import (
    LANES,
    bits,
    entry,
    exp2,
    load,
    lowest_bit,
    maximum,
    minimum,
    store,
    total,
    where,
)

TILE = 16
"""Side of a tile, pixels."""
SPLAT_COLUMNS = 6
"""Columns of a splat: x, y, shear, steepness, rise and log2 of opacity. At (dx, dy) from the center, log2 of
alpha is log2 opacity − steepness·(dx + shear·dy)² − rise·dy², which stays accurate far from the center of a
needle."""
UNROLL = 4
"""Channels composited at a time. Their number is rounded up to a multiple of this."""
WAVE = 32
PIXELS = TILE * TILE
CHANNELS_FROM = 6
"""First channel column of a row's sums. In the six columns before it, the gradient with respect to ln(alpha)
is summed, times u², u·dy, dy², u, dy and 1, where u = dx + shear·dy. Unlike dx, u is small along a needle,
so that nothing cancels in float32."""
_BLOCKS = PIXELS // LANES
_BLOCK_WIDTH, _BLOCK_HEIGHT = 8, 2
_REACH = math.log2(ALPHA_MIN) - 0.01  # with a margin for rounding


class Maps(NamedTuple):
    """Composited maps, or their gradients."""

    image: Float[np.ndarray, "h w c"]
    alphas: Float[np.ndarray, "h w 1"]


class Trace(NamedTuple):
    """Data that the forward pass leaves for the backward pass."""

    wave_starts: Int[np.ndarray, " tiles+1"]
    """First record of each tile."""
    records: Float[np.ndarray, "waves pixels"]
    """Transmittance in front of each wave."""
    ends: Int[np.ndarray, " tiles"]
    """Number of rows of each tile that were processed before all its pixels stopped."""


class _Splat(NamedTuple):
    """A Gaussian on the screen, in pixels from the tile's corner (see `SPLAT_COLUMNS`)."""

    x: float
    y: float
    shear: float
    steepness: float
    rise: float
    log2_opacity: float


class _Centers(NamedTuple):
    """Centers of a tile's pixels, counted from its corner."""

    x: Float[np.ndarray, " pixels"]
    y: Float[np.ndarray, " pixels"]
    rows: Any
    """Vector of the 16 pixel rows' y."""


class _Wave(NamedTuple):
    """What is known of a wave's rows once they are composited: one slot per row and block that it reaches."""

    masks: Int[np.ndarray, " rows"]
    """Blocks that each row reaches."""
    starts: Int[np.ndarray, " rows+1"]
    """First slot of each row."""
    places: Int[np.ndarray, " slots"]
    """First pixel of each slot's block."""
    alphas: Float[np.ndarray, " slots*lanes"]
    weights: Float[np.ndarray, " slots*lanes"]
    values: Float[np.ndarray, " slots*lanes"]
    """Σ channel × upstream gradient."""


@numba.njit
def _aligned(size, like):
    """Allocate an array aligned to cache lines, because a vector across two of them costs twice as much."""
    room = np.empty(size + 64 // like.itemsize, like.dtype)
    first = -room.ctypes.data % 64 // like.itemsize
    return room[first : first + size]


@numba.njit(forceinline=True)
def _place(pixel):
    """Return column and row in the tile of a pixel. Pixels are numbered block by block."""
    block, lane = pixel // LANES, pixel % LANES
    return block % 2 * _BLOCK_WIDTH + lane % _BLOCK_WIDTH, block // 2 * _BLOCK_HEIGHT + lane // _BLOCK_WIDTH


@numba.njit
def _pixel_centers(like):
    x, y, rows = _aligned(PIXELS, like), _aligned(PIXELS, like), _aligned(LANES, like)
    for pixel in range(PIXELS):
        column, row = _place(pixel)
        x[pixel], y[pixel] = column + 0.5, row + 0.5
    for lane in range(LANES):
        rows[lane] = lane + 0.5
    return _Centers(x, y, load(rows, 0))


@numba.njit
def _empty_wave(like):
    masks, starts = np.empty(WAVE, np.int64), np.empty(WAVE + 1, np.int64)
    places, room = np.empty(WAVE * _BLOCKS, np.int64), WAVE * PIXELS
    alphas, weights, values = _aligned(room, like), _aligned(room, like), _aligned(room, like)
    return _Wave(masks, starts, places, alphas, weights, values)


@numba.njit
def _blocks_inside(tile, width, height):
    """Return the tile's first pixel, and the mask of blocks that have pixels in the image."""
    columns = (width + TILE - 1) // TILE
    y, x = tile // columns * TILE, tile % columns * TILE
    mask = 0
    for block in range(_BLOCKS):
        column, row = _place(block * LANES)
        if x + column < width and y + row < height:
            mask |= 1 << block
    return x, y, mask


@numba.njit(forceinline=True)
def _splat(splats, rank, corner_x, corner_y):
    kind, at = splats.dtype.type, rank * SPLAT_COLUMNS
    x, y = entry(splats, at) - kind(corner_x), entry(splats, at + 1) - kind(corner_y)
    shear, steepness, rise = entry(splats, at + 2), entry(splats, at + 3), entry(splats, at + 4)
    return _Splat(x, y, shear, steepness, rise, entry(splats, at + 5))


@numba.njit(forceinline=True)
def _blocks_reached(splat, rows):
    """Return the mask of blocks in which a Gaussian reaches 1/255. Along a row of pixels, alpha is largest
    where dx = −shear·dy, or at the end nearest to it."""
    dy = rows - splat.y
    peak = dy * -splat.shear
    height = splat.log2_opacity - dy * dy * splat.rise
    left, right = 0.5 - splat.x, 0.5 + _BLOCK_WIDTH - splat.x
    near_left = minimum(maximum(peak, left), left + (_BLOCK_WIDTH - 1)) - peak
    near_right = minimum(maximum(peak, right), right + (_BLOCK_WIDTH - 1)) - peak
    rows_left = bits(height - near_left * near_left * splat.steepness >= _REACH)
    rows_right = bits(height - near_right * near_right * splat.steepness >= _REACH)
    return ((rows_left | rows_left >> 1) & 0x5555) | ((rows_right | rows_right >> 1) & 0x5555) << 1


@numba.njit(forceinline=True)
def _reach(plan, begin, count, corner_x, corner_y, rows, masks):
    """Compute the masks of one wave's rows together, which avoids stalls."""
    for k in range(count):
        masks[k] = _blocks_reached(_splat(plan.splats, plan.ranks[begin + k], corner_x, corner_y), rows)


@numba.njit(forceinline=True)
def _blend(splat, centers, at, transmittance):
    """Put a Gaussian behind what a block's pixels show so far. Returns its alpha and its weight in them, and
    which of them continue; stores the transmittance behind it."""
    dx, dy = load(centers.x, at) - splat.x, load(centers.y, at) - splat.y
    slanted = dx + dy * splat.shear
    log2_alpha = (splat.log2_opacity - dy * dy * splat.rise) - slanted * slanted * splat.steepness
    alpha = minimum(exp2(maximum(log2_alpha, -20.0)), ALPHA_MAX)
    alpha = where(alpha >= ALPHA_MIN, alpha, 0.0)
    before = load(transmittance, at)
    weight = before * alpha
    after = before - weight
    going = after > TRANSMITTANCE_MIN
    store(transmittance, at, where(going, after, 0.0))
    return where(going, alpha, 0.0), where(going, weight, 0.0), bits(going) != 0


@kernel
def composite_tiles(tiles, plan, maps, trace, keep):
    """Composite some tiles of a `Plan` into the maps. `keep` also fills the trace for a backward pass."""
    channels = plan.table.shape[1]
    transmittance, sums = _aligned(PIXELS, plan.splats), _aligned(channels * PIXELS, plan.splats)
    centers, masks = _pixel_centers(plan.splats), np.empty(WAVE, np.int64)
    for tile in tiles:
        corner_x, corner_y, live = _blocks_inside(tile, plan.width, plan.height)
        transmittance[:] = 1
        sums[:] = 0
        begin, wave = plan.starts[tile], 0
        while begin < plan.starts[tile + 1] and live:
            if keep:
                trace.records[trace.wave_starts[tile] + wave] = transmittance
            count = min(WAVE, plan.starts[tile + 1] - begin)
            _reach(plan, begin, count, corner_x, corner_y, centers.rows, masks)
            for k in range(count):
                todo = masks[k] & live
                rank = plan.ranks[begin + k]
                splat = _splat(plan.splats, rank, corner_x, corner_y)
                while todo:
                    block = lowest_bit(todo)
                    todo &= todo - 1
                    at = block * LANES
                    _, weight, going = _blend(splat, centers, at, transmittance)
                    if not going:
                        live &= ~(1 << block)
                    place, column = at * channels, rank * channels
                    for _ in range(0, channels, UNROLL):
                        for _ in range(UNROLL):
                            store(sums, place, load(sums, place) + weight * entry(plan.table, column))
                            place += LANES
                            column += 1
            begin += count
            wave += 1
        trace.ends[tile] = begin - plan.starts[tile]
        colors = maps.image.shape[2]
        for pixel in range(PIXELS):
            column, row = _place(pixel)
            px, py = corner_x + column, corner_y + row
            at = pixel // LANES * LANES * channels + pixel % LANES
            if px < plan.width and py < plan.height:
                for c in range(colors):
                    maps.image[py, px, c] = sums[c * LANES + at]
                maps.alphas[py, px, 0] = sums[colors * LANES + at]


@kernel
def backward_tiles(tiles, plan, maps, trace, sums):
    """Sum the gradients of some tiles per visible Gaussian. `maps` has the gradients of the output maps.

    Waves are processed from the back: each is composited again, front to back, and then walked in reverse.
    With v = Σ channel × upstream, and B the same sum for everything behind, composited over black, the
    gradient with respect to ln(alpha) is weight·(v − B), and B in front is B + alpha·(v − B)."""
    channels, like = plan.table.shape[1], plan.splats
    sums[:] = 0
    upstream = _aligned(channels * PIXELS, like)
    upstream[:] = 0
    transmittance, behind = _aligned(PIXELS, like), _aligned(PIXELS, like)
    centers, wave = _pixel_centers(like), _empty_wave(like)
    zero = centers.rows * 0.0
    for tile in tiles:
        rows = trace.ends[tile]
        if not rows:
            continue
        corner_x, corner_y, inside = _blocks_inside(tile, plan.width, plan.height)
        _read_upstream(plan, maps, corner_x, corner_y, upstream)
        behind[:] = 0
        for number in range((rows - 1) // WAVE, -1, -1):
            begin = plan.starts[tile] + number * WAVE
            count = min(WAVE, plan.starts[tile] + rows - begin)
            transmittance[:] = trace.records[trace.wave_starts[tile] + number]
            _composite_again(plan, begin, count, corner_x, corner_y, inside, centers, transmittance, wave)
            for k in range(count - 1, -1, -1):
                first, last = wave.starts[k], wave.starts[k + 1]
                if first < last:
                    rank = plan.ranks[begin + k]
                    splat = _splat(plan.splats, rank, corner_x, corner_y)
                    _set_values(plan, upstream, rank, first, last, wave)
                    _add_shape(centers, splat, first, last, wave, behind, zero, sums[rank])
                    _add_channels(upstream, first, last, wave, channels, zero, sums[rank])


@numba.njit(forceinline=True)
def _composite_again(plan, begin, count, corner_x, corner_y, inside, centers, transmittance, wave):
    """Composite the rows of one wave, from the transmittance in front of it, and keep alphas and weights."""
    live = inside
    for block in range(_BLOCKS):
        if not bits(load(transmittance, block * LANES) > 0.0):
            live &= ~(1 << block)
    _reach(plan, begin, count, corner_x, corner_y, centers.rows, wave.masks)
    slot = 0
    for k in range(count):
        splat = _splat(plan.splats, plan.ranks[begin + k], corner_x, corner_y)
        todo, wave.starts[k] = wave.masks[k] & live, slot
        while todo:
            block = lowest_bit(todo)
            todo &= todo - 1
            at = block * LANES
            alpha, weight, going = _blend(splat, centers, at, transmittance)
            if not going:
                live &= ~(1 << block)
            wave.places[slot] = at
            store(wave.alphas, slot * LANES, alpha)
            store(wave.weights, slot * LANES, weight)
            slot += 1
    wave.starts[count] = slot


@numba.njit(forceinline=True)
def _read_upstream(plan, maps, corner_x, corner_y, upstream):
    """Read a tile of the maps' gradients, channel by channel in each block; they are 0 outside the image."""
    channels, colors = plan.table.shape[1], maps.image.shape[2]
    for pixel in range(PIXELS):
        column, row = _place(pixel)
        px, py = corner_x + column, corner_y + row
        at = pixel // LANES * LANES * channels + pixel % LANES
        within = px < plan.width and py < plan.height
        for c in range(colors):
            upstream[c * LANES + at] = maps.image[py, px, c] if within else 0
        upstream[colors * LANES + at] = maps.alphas[py, px, 0] if within else 0


@numba.njit(forceinline=True)
def _set_values(plan, upstream, rank, first, last, wave):
    """Compute Σ channel × upstream in a row's slots."""
    channels = plan.table.shape[1]
    for c in range(0, channels, UNROLL):
        column = rank * channels + c
        for slot in range(first, last):
            at = entry(wave.places, slot) * channels + c * LANES
            value = load(upstream, at) * entry(plan.table, column)
            value += load(upstream, at + LANES) * entry(plan.table, column + 1)
            value += load(upstream, at + 2 * LANES) * entry(plan.table, column + 2)
            value += load(upstream, at + 3 * LANES) * entry(plan.table, column + 3)
            if c:
                value += load(wave.values, slot * LANES)
            store(wave.values, slot * LANES, value)


@numba.njit(forceinline=True)
def _add_shape(centers, splat, first, last, wave, behind, zero, sums):
    """Add the moments of a row's gradients (see `CHANNELS_FROM`), and move `behind` in front of it."""
    m, mu, my, muu, muy, myy = zero, zero, zero, zero, zero, zero
    for slot in range(first, last):
        at = entry(wave.places, slot)
        dx, dy = load(centers.x, at) - splat.x, load(centers.y, at) - splat.y
        back, alpha = load(behind, at), load(wave.alphas, slot * LANES)
        over = load(wave.values, slot * LANES) - back
        store(behind, at, back + alpha * over)
        slope = where(alpha < ALPHA_MAX, load(wave.weights, slot * LANES) * over, 0.0)
        slanted = dx + dy * splat.shear
        slope_u, slope_y = slope * slanted, slope * dy
        m += slope
        mu += slope_u
        my += slope_y
        muu += slope_u * slanted
        muy += slope_u * dy
        myy += slope_y * dy
    sums[0] += total(muu)
    sums[1] += total(muy)
    sums[2] += total(myy)
    sums[3] += total(mu)
    sums[4] += total(my)
    sums[5] += total(m)


@numba.njit(forceinline=True)
def _add_channels(upstream, first, last, wave, channels, zero, sums):
    """Add the gradients of a row's channels."""
    for c in range(0, channels, UNROLL):
        g0, g1, g2, g3 = zero, zero, zero, zero
        for slot in range(first, last):
            at, weight = entry(wave.places, slot) * channels + c * LANES, load(wave.weights, slot * LANES)
            g0 += load(upstream, at) * weight
            g1 += load(upstream, at + LANES) * weight
            g2 += load(upstream, at + 2 * LANES) * weight
            g3 += load(upstream, at + 3 * LANES) * weight
        sums[CHANNELS_FROM + c] += total(g0)
        sums[CHANNELS_FROM + c + 1] += total(g1)
        sums[CHANNELS_FROM + c + 2] += total(g2)
        sums[CHANNELS_FROM + c + 3] += total(g3)
