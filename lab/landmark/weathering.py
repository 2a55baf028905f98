"""Weathering: stains, stones and grain of a place's own, so that no two walls or windows look exactly alike.

Shapes stay as they are, and a building still looks alike from several sides; its surface repeats nowhere, as
on real buildings.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray as Array

from lab.landmark.materials import resolved

_PERIODS, _SAMPLES = 16, 16  # of the table of noise, per axis and per period
_SIZES = (7.1, 3.3, 1.45, 0.62, 0.27, 0.12, 0.053, 0.023)
"""Sizes of stains and grain, meters; about an octave apart, without a common multiple."""
_CONTRAST = 0.32
"""Range of the reflectance that every size adds: walls have about equal contrast in every octave."""
_BLOCK = 1 << 15  # points at once, whose arrays stay in the processor's cache
_TINT = 0.12, 0.7
"""Range of brightness between copies of a wall, and between windows (curtains, lamps, reflections)."""


def stains(at: Float[Array, "n 3"], footprint: Float[Array, " n"], seed: int) -> Float[Array, " n"]:
    """Compute factors on the reflectance at points of the world (meters), whose pixels have this footprint
    (meters)."""
    factor, table = np.ones(len(at), np.float32), _noise_table()
    period = len(table)
    added = ((np.arange(256) / 255 - 0.5) * _CONTRAST).astype(np.float32)
    for start in range(0, len(at), _BLOCK):
        run = slice(start, start + _BLOCK)
        columns, pixel, total = np.ascontiguousarray(at[run].T), footprint[run], factor[run]
        for octave, size in enumerate(_SIZES):
            share = resolved(size, pixel)
            if not share.any():
                break
            cells = (columns * np.float32(_SAMPLES / size)).astype(np.int32) + 53 * (seed + 7 * octave)
            x, y, z = cells & (period - 1)
            total += share * added.take(table.take((x * period + y) * period + z))
    return np.maximum(factor, 0.2)


def own_place(copy: Int[Array, " n"], shape: int) -> tuple[Array, Array]:
    """Return offsets of the texture, in meters, for copies (sides, windows) of a shape."""
    return 40 * _hash(copy, shape, 1), 40 * _hash(copy, shape, 2)


def tint(copy: Int[Array, " n"], shape: int, window: Array) -> Float[Array, " n"]:
    """Return the brightness of copies of a shape; windows differ more than walls."""
    wall, pane = _TINT
    return 1 + np.where(window, np.float32(pane), np.float32(wall)) * (_hash(copy, shape, 3) - 0.5)


def _hash(copy: Int[Array, " n"], shape: int, kind: int) -> Float[Array, " n"]:
    """Look up a random number in [0, 1) for every copy."""
    rng = np.random.default_rng([shape, kind])
    return rng.random(int(np.max(copy, initial=0)) + 1, dtype=np.float32)[copy]


@cache
def _noise_table() -> UInt8[Array, "size size size"]:
    """Make smooth periodic noise."""
    table: np.ndarray = np.random.default_rng(21).random((_PERIODS,) * 3, dtype=np.float32)
    x = np.arange(_PERIODS * _SAMPLES) / _SAMPLES
    i, f = x.astype(int), (x % 1).astype(np.float32)
    f = f * f * (3 - 2 * f)
    for axis in range(3):
        weight = f.reshape([-1 if a == axis else 1 for a in range(3)])
        table = table.take(i, axis) * (1 - weight) + table.take((i + 1) % _PERIODS, axis) * weight
    return np.clip((table - 0.5) * 1.6 * 255 + 127.5, 0, 255).astype(np.uint8)
