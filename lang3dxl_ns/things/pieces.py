"""Pieces of heat maps: connected regions of one view, split where they fall apart, and their Gaussians."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from scipy.ndimage import find_objects, label

LEVELS = (0.3, 0.5, 0.7, 0.85)
"""Heights at which a map is cut. A region that falls apart at a higher level is several things."""
LEAST = 6
"""Pixels below which a region is noise."""
PART = 0.25
"""Share of a region that each of its parts must hold for the region to be split."""
DEPTH = 0.03
"""Relative distance from the visible surface, or from what matches, within which a Gaussian belongs to a
pixel."""
FILLED = 0.5
"""Pixels that a Gaussian must fill in a view to belong to a piece of it: fainter ones are seen through."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A region of one view that matches a word."""

    photo: str
    """Name of the view's photo."""
    rows: Int[Array, " m"]
    """Indices of the Gaussians that it shows."""
    resolution: float
    """Pixels per world unit at its distance."""
    area: int
    """Pixels in it."""
    box: tuple[int, int, int, int]
    """Left, top, right and bottom end in pixels of the training photo."""
    cut: bool
    """Whether the picture's edge cuts it off."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What one photo's view shows of a word."""

    photo: str
    heat: Float[Array, "h w"]
    """Heat map, 0…1."""
    depth: Float[Array, "h w"]
    """Depth of the visible surface, world units."""
    matched: Float[Array, "h w"]
    """Mean depth of what matches, world units: panes lie behind the edges of the wall around them."""
    rows: Int[Array, " m"]
    """Indices of the Gaussians that fill enough of the view."""
    points: Float[Array, "m 3"]
    """Column and row of these Gaussians' centers in pixels, and their depth."""
    focal: float
    """Focal length, pixels."""


def pieces_of(shown: Shown) -> Iterator[Piece]:
    """Yield the pieces of a view that show at least one Gaussian."""
    labels, count = split(shown.heat)
    height, width = labels.shape
    x, y, z = shown.points.T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y, z, rows = x[inside].astype(int), y[inside].astype(int), z[inside], shown.rows[inside]
    near = (abs(z - shown.depth[y, x]) < DEPTH * z) | (abs(z - shown.matched[y, x]) < DEPTH * z)
    on = (labels[y, x] > 0) & near
    which, rows = labels[y, x][on], rows[on]
    order = which.argsort(kind="stable")
    ends = np.searchsorted(which[order], np.arange(1, count + 2))
    for i, (down, across) in enumerate(find_objects(labels)):
        own = rows[order[ends[i] : ends[i + 1]]]
        region = labels[down, across] == i + 1
        if len(own):
            depth = float(np.median(shown.depth[down, across][region]))
            box = across.start, down.start, across.stop, down.stop
            cut = box[0] <= 1 or box[1] <= 1 or box[2] >= width - 1 or box[3] >= height - 1
            yield Piece(shown.photo, own, shown.focal / depth, int(region.sum()), box, cut)


def split(heat: Float[Array, "h w"]) -> tuple[Int[Array, "h w"], int]:
    """Number the pieces of a heat map from 1, and return how many there are; 0 marks the rest."""
    labels, count = np.zeros(heat.shape, int), 0
    regions, _ = label(heat > LEVELS[0])
    for i, where in enumerate(find_objects(regions)):
        region = regions[where] == i + 1
        if region.sum() >= LEAST:
            for leaf in _leaves(region, heat[where], 1):
                count += 1
                labels[where][leaf] = count
    return labels, count


def _leaves(region: Bool[Array, "h w"], heat: Float[Array, "h w"], level: int) -> list[Bool[Array, "h w"]]:
    """Return the parts that a region falls into above some level, each as it is there; or the region."""
    if level == len(LEVELS):
        return [region]
    parts, _ = label(region & (heat > LEVELS[level]))
    areas = np.bincount(parts.ravel())[1:]
    large = [parts == i + 1 for i in np.flatnonzero(areas >= max(LEAST, PART * region.sum()))]
    leaves = [leaf for part in large for leaf in _leaves(part, heat, level + 1)]
    return leaves if len(leaves) > 1 else [region]
