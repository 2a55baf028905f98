"""Numba kernels that composite tiles, forward and backward, in vectors of 16 pixels.

A tile of 16 × 16 pixels is divided into 16 blocks of 8 × 2, one vector each. Front to back, each Gaussian is
composited into those blocks of its tile that it reaches and that have not stopped. Rows are the
pairs of tile and Gaussian (see `fused_plan.Plan`); they are processed in waves of 32.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from lang3dxl_ns.common.jit import kernel
from lang3dxl_ns.rendering.ellipses import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from lang3dxl_ns.rendering.fused_plan import SPLAT_COLUMNS, TILE, UNROLL
from lang3dxl_ns.rendering.simd import (
    LANES,
    absolute,
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

WAVE = 32
PIXELS = TILE * TILE
SHAPE_COLUMNS = 6
"""Gradients per row: conic xx, xy, yy; first moments x, y; ln opacity."""
ABSOLUTE_COLUMNS = 2
"""Sums of the absolute pixel gradients of the screen position, x and y."""
CHANNELS_FROM = SHAPE_COLUMNS + ABSOLUTE_COLUMNS
"""First column of the channels' gradients, after those of the shape and the absolute ones."""
_BLOCKS = PIXELS // LANES
_BLOCK_WIDTH, _BLOCK_HEIGHT = 8, 2
_REACH = math.log2(ALPHA_MIN) - 0.01  # with a margin for rounding


@numba.njit
def _aligned(size, like):
    """An array aligned to cache lines: a vector across two of them costs twice as much."""
    room = np.empty(size + 64 // like.itemsize, like.dtype)
    first = -room.ctypes.data % 64 // like.itemsize
    return room[first : first + size]


@numba.njit
def _pixel_centers(like):
    """x and y of all blocks' pixels from the tile's corner, and y of the pixel rows."""
    across, down = _aligned(PIXELS, like), _aligned(PIXELS, like)
    lines = _aligned(LANES, like)
    for at in range(PIXELS):
        block, lane = at // LANES, at % LANES
        across[at] = block % 2 * _BLOCK_WIDTH + lane % _BLOCK_WIDTH + 0.5
        down[at] = block // 2 * _BLOCK_HEIGHT + lane // _BLOCK_WIDTH + 0.5
    for lane in range(LANES):
        lines[lane] = lane + 0.5
    return across, down, load(lines, 0)


@numba.njit
def _blocks_inside(tile, width, height):
    """The tile's first pixel, and the mask of blocks that have pixels in the image."""
    columns = (width + TILE - 1) // TILE
    y, x = tile // columns * TILE, tile % columns * TILE
    mask = 0
    for block in range(_BLOCKS):
        if x + block % 2 * _BLOCK_WIDTH < width and y + block // 2 * _BLOCK_HEIGHT < height:
            mask |= 1 << block
    return x, y, mask


@numba.njit(forceinline=True)
def _splat(splats, rank, corner_x, corner_y):
    """x, y from the tile's corner, shear, steepness, rise, log2 of opacity."""
    kind, at = splats.dtype.type, rank * SPLAT_COLUMNS
    x, y = entry(splats, at) - kind(corner_x), entry(splats, at + 1) - kind(corner_y)
    return x, y, entry(splats, at + 2), entry(splats, at + 3), entry(splats, at + 4), entry(splats, at + 5)


@numba.njit(forceinline=True)
def _blocks_reached(x, y, shear, steepness, rise, log2_opacity, lines):
    """The mask of blocks in which the Gaussian at (x, y) from the tile's corner reaches 1/255.

    Row by row: along a row of pixels alpha is largest where dx = −shear·dy, or at the end nearest to it.
    """
    dy = lines - y
    peak = dy * -shear
    height = log2_opacity - dy * dy * rise
    left, right = 0.5 - x, 0.5 + _BLOCK_WIDTH - x
    near_left = minimum(maximum(peak, left), left + (_BLOCK_WIDTH - 1)) - peak
    near_right = minimum(maximum(peak, right), right + (_BLOCK_WIDTH - 1)) - peak
    rows_left = bits(height - near_left * near_left * steepness >= _REACH)
    rows_right = bits(height - near_right * near_right * steepness >= _REACH)
    return ((rows_left | rows_left >> 1) & 0x5555) | ((rows_right | rows_right >> 1) & 0x5555) << 1


@numba.njit(forceinline=True)
def _reach(splats, ranks, begin, count, corner_x, corner_y, lines, masks):
    """The masks of one wave's rows, computed together to avoid stalls."""
    for k in range(count):
        x, y, shear, steepness, rise, log2_opacity = _splat(splats, ranks[begin + k], corner_x, corner_y)
        masks[k] = _blocks_reached(x, y, shear, steepness, rise, log2_opacity, lines)


@numba.njit(forceinline=True)
def _alpha(dx, dy, shear, steepness, rise, log2_opacity):
    slanted = dx + dy * shear
    log2_alpha = (log2_opacity - dy * dy * rise) - slanted * slanted * steepness
    alpha = minimum(exp2(maximum(log2_alpha, -20.0)), ALPHA_MAX)
    return where(alpha >= ALPHA_MIN, alpha, 0.0)


@kernel
def composite_tiles(
    tiles, splats, table, attached, starts, ranks, width, height, image, features, alphas, keep,
    wave_starts, records, ends,
):  # fmt: skip
    """Composite some tiles into the maps."""
    channels = table.shape[1]
    transmittance, sums = _aligned(PIXELS, splats), _aligned(channels * PIXELS, splats)
    across, down, lines = _pixel_centers(splats)
    masks = np.empty(WAVE, np.int64)
    for tile in tiles:
        corner_x, corner_y, live = _blocks_inside(tile, width, height)
        transmittance[:] = 1
        sums[:] = 0
        begin, wave = starts[tile], 0
        while begin < starts[tile + 1] and live:
            if keep:
                records[wave_starts[tile] + wave] = transmittance
            count = min(WAVE, starts[tile + 1] - begin)
            _reach(splats, ranks, begin, count, corner_x, corner_y, lines, masks)
            for k in range(count):
                todo = masks[k] & live
                rank = ranks[begin + k]
                x, y, shear, steepness, rise, log2_opacity = _splat(splats, rank, corner_x, corner_y)
                while todo:
                    block = lowest_bit(todo)
                    todo &= todo - 1
                    at = block * LANES
                    dx, dy = load(across, at) - x, load(down, at) - y
                    alpha = _alpha(dx, dy, shear, steepness, rise, log2_opacity)
                    before = load(transmittance, at)
                    weight = before * alpha
                    after = before - weight
                    going = after > TRANSMITTANCE_MIN
                    weight = where(going, weight, 0.0)
                    store(transmittance, at, where(going, after, 0.0))
                    if bits(going) == 0:
                        live &= ~(1 << block)
                    place, column = at * channels, rank * channels
                    for _ in range(0, channels, UNROLL):
                        for _ in range(UNROLL):
                            store(sums, place, load(sums, place) + weight * entry(table, column))
                            place += LANES
                            column += 1
            begin += count
            wave += 1
        ends[tile] = begin - starts[tile]
        for block in range(_BLOCKS):
            for lane in range(LANES):
                px = corner_x + block % 2 * _BLOCK_WIDTH + lane % _BLOCK_WIDTH
                py = corner_y + block // 2 * _BLOCK_HEIGHT + lane // _BLOCK_WIDTH
                at = block * LANES * channels + lane
                if px < width and py < height:
                    for c in range(image.shape[2]):
                        image[py, px, c] = sums[c * LANES + at]
                    alphas[py, px, 0] = sums[image.shape[2] * LANES + at]
                    for c in range(features.shape[2]):
                        features[py, px, c] = sums[(attached + c) * LANES + at]


@kernel
def backward_tiles(
    tiles, splats, table, attached, starts, ranks, width, height, image, features, alphas,
    wave_starts, records, ends, absolutes, sums,
):  # fmt: skip
    """Sum the gradients of some tiles per visible Gaussian.

    Wave by wave from the back: alpha and weight are recomputed front to back, then used in reverse.
    With v = Σ channel × upstream, and B the same for everything behind, composited over black, the gradient
    with respect to ln(alpha) is weight·(v − B), and B in front of the Gaussian is B + alpha·(v − B).
    """
    channels = table.shape[1]
    sums[:] = 0
    upstream = _aligned(channels * PIXELS, splats)
    upstream[:] = 0
    transmittance, behind = _aligned(PIXELS, splats), _aligned(PIXELS, splats)
    alpha_of, weight_of, value_of = (
        _aligned(WAVE * PIXELS, splats),
        _aligned(WAVE * PIXELS, splats),
        _aligned(WAVE * PIXELS, splats),
    )
    masks, slots = np.empty(WAVE, np.int64), np.empty(WAVE + 1, np.int64)
    across, down, lines = _pixel_centers(splats)
    zero = lines * 0.0
    for tile in tiles:
        corner_x, corner_y, inside = _blocks_inside(tile, width, height)
        behind[:] = 0
        if not ends[tile]:
            continue
        for block in range(_BLOCKS):
            for lane in range(LANES):
                px = corner_x + block % 2 * _BLOCK_WIDTH + lane % _BLOCK_WIDTH
                py = corner_y + block // 2 * _BLOCK_HEIGHT + lane // _BLOCK_WIDTH
                at = block * LANES * channels + lane
                within = px < width and py < height
                for c in range(image.shape[2]):
                    upstream[c * LANES + at] = image[py, px, c] if within else 0
                upstream[image.shape[2] * LANES + at] = alphas[py, px, 0] if within else 0
                for c in range(features.shape[2]):
                    upstream[(attached + c) * LANES + at] = features[py, px, c] if within else 0
        for wave in range((ends[tile] - 1) // WAVE, -1, -1):
            begin = starts[tile] + wave * WAVE
            count = min(WAVE, starts[tile] + ends[tile] - begin)
            transmittance[:] = records[wave_starts[tile] + wave]
            live = 0
            for block in range(_BLOCKS):
                if inside & (1 << block) and bits(load(transmittance, block * LANES) > 0.0):
                    live |= 1 << block
            _reach(splats, ranks, begin, count, corner_x, corner_y, lines, masks)
            slot = 0
            for k in range(count):
                rank = ranks[begin + k]
                x, y, shear, steepness, rise, log2_opacity = _splat(splats, rank, corner_x, corner_y)
                todo = masks[k] & live
                masks[k], slots[k] = todo, slot
                while todo:
                    block = lowest_bit(todo)
                    todo &= todo - 1
                    at = block * LANES
                    dx, dy = load(across, at) - x, load(down, at) - y
                    alpha = _alpha(dx, dy, shear, steepness, rise, log2_opacity)
                    before = load(transmittance, at)
                    weight = before * alpha
                    after = before - weight
                    going = after > TRANSMITTANCE_MIN
                    store(alpha_of, slot, where(going, alpha, 0.0))
                    store(weight_of, slot, where(going, weight, 0.0))
                    store(transmittance, at, where(going, after, 0.0))
                    if bits(going) == 0:
                        live &= ~(1 << block)
                    slot += LANES
            slots[count] = slot
            for k in range(count - 1, -1, -1):
                if not masks[k]:
                    continue
                rank = ranks[begin + k]
                x, y, shear, steepness, rise, _ = _splat(splats, rank, corner_x, corner_y)
                for c in range(0, attached, UNROLL):
                    slot, todo = slots[k], masks[k]
                    while todo:
                        block = lowest_bit(todo)
                        todo &= todo - 1
                        at = (block * channels + c) * LANES
                        value = load(upstream, at) * entry(table, rank * channels + c)
                        value += load(upstream, at + LANES) * entry(table, rank * channels + c + 1)
                        value += load(upstream, at + 2 * LANES) * entry(table, rank * channels + c + 2)
                        value += load(upstream, at + 3 * LANES) * entry(table, rank * channels + c + 3)
                        if c:
                            value += load(value_of, slot)
                        store(value_of, slot, value)
                        slot += LANES
                slot, todo = slots[k], masks[k]
                m, mx, my, mxx, mxy, myy = zero, zero, zero, zero, zero, zero
                abs_x, abs_y = zero, zero
                while todo:
                    block = lowest_bit(todo)
                    todo &= todo - 1
                    at = block * LANES
                    dx, dy = load(across, at) - x, load(down, at) - y
                    back, alpha = load(behind, at), load(alpha_of, slot)
                    over = load(value_of, slot) - back
                    store(behind, at, back + alpha * over)
                    slope = where(alpha < ALPHA_MAX, load(weight_of, slot) * over, 0.0)
                    slope_x, slope_y = slope * dx, slope * dy
                    m += slope
                    mx += slope_x
                    my += slope_y
                    mxx += slope_x * dx
                    mxy += slope_x * dy
                    myy += slope_y * dy
                    if absolutes:
                        tilt = (dx + dy * shear) * steepness
                        abs_x += absolute(slope * tilt)
                        abs_y += absolute(slope * (tilt * shear + dy * rise))
                    slot += LANES
                sums[rank, 0] += total(mxx)
                sums[rank, 1] += total(mxy)
                sums[rank, 2] += total(myy)
                sums[rank, 3] += total(mx)
                sums[rank, 4] += total(my)
                sums[rank, 5] += total(m)
                if absolutes:
                    sums[rank, 6] += total(abs_x)
                    sums[rank, 7] += total(abs_y)
                for c in range(0, channels, UNROLL):
                    slot, todo = slots[k], masks[k]
                    g0, g1, g2, g3 = zero, zero, zero, zero
                    while todo:
                        block = lowest_bit(todo)
                        todo &= todo - 1
                        at = (block * channels + c) * LANES
                        weight = load(weight_of, slot)
                        g0 += load(upstream, at) * weight
                        g1 += load(upstream, at + LANES) * weight
                        g2 += load(upstream, at + 2 * LANES) * weight
                        g3 += load(upstream, at + 3 * LANES) * weight
                        slot += LANES
                    sums[rank, CHANNELS_FROM + c] += total(g0)
                    sums[rank, CHANNELS_FROM + c + 1] += total(g1)
                    sums[rank, CHANNELS_FROM + c + 2] += total(g2)
                    sums[rank, CHANNELS_FROM + c + 3] += total(g3)
