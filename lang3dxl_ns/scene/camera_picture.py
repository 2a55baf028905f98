"""Picture of a reconstruction's cameras and points, from above and from the side."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from PIL import Image, ImageDraw

from lang3dxl_ns.common.captions import letters
from lang3dxl_ns.common.errors import printable
from lang3dxl_ns.scene.frame import COLMAP_UP, find_frame

_PANEL = 900  # pixels of a panel's side
_MARGIN = 60
_DOTS = 40_000
_LETTERS = 15  # pixels
_MOST_NAMES = 40
_WHITE, _GRAY, _BLUE, _RED = (255, 255, 255), (165, 165, 165), (20, 90, 200), (210, 20, 20)
_PYRAMID = np.array([[0, 0, 0], [-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]])
"""A camera's tip and the corners of its base: x right, y down, z forward."""
_EDGES = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]


def camera_picture(
    poses: Float[Array, "n 3 4"], names: Sequence[str], doubtful: Collection[str], points: Float[Array, "m 3"]
) -> Image.Image:
    """Draw cameras as pyramids and points as gray dots: from above on the left, from the side on the right.

    Doubtful photos are red and carry their names. What lies far outside stands at the border.

    Args:
        poses: camera → world; camera axes x right, y down, z forward. At least one.
        names: the photos' names.
        doubtful: names of the photos that may stand wrong.
        points: positions in the same world, any unit.
    """
    flipped = poses * np.array([1.0, -1, -1, 1])
    frame = find_frame(flipped, points, COLMAP_UP, "vertical", "none", auto_scale=False)
    centers = frame.points(poses[:, :, 3])
    dots = frame.points(points[:: len(points) // _DOTS + 1])
    middle, reach = _extent(centers, dots)
    size = reach / 18 * min(1.0, (30 / len(poses)) ** 0.5)
    turned = frame.transform[:, :3] @ poses[:, :, :3]
    pyramids = centers[:, None] + size * (turned @ _PYRAMID.T).transpose(0, 2, 1)
    red = [name in doubtful for name in names]
    canvas = Image.new("RGB", (2 * _PANEL, _PANEL), _WHITE)
    pen, font = ImageDraw.Draw(canvas), letters(_LETTERS)
    for panel, title in enumerate(("from above", "from the side")):
        pen.point(_pixels(dots, middle, reach, panel), fill=_GRAY)
        for i in sorted(range(len(names)), key=red.__getitem__):  # red on top
            corners = _pixels(pyramids[i], middle, reach, panel)
            for start, end in _EDGES:
                pen.line([corners[start], corners[end]], fill=_RED if red[i] else _BLUE, width=1 + red[i])
        for i in np.flatnonzero(red)[:_MOST_NAMES]:
            ((x, y),) = _pixels(centers[i : i + 1], middle, reach, panel)
            name = printable(names[i])
            x = min(x + 4, _PANEL * (panel + 1) - pen.textlength(name, font) - 4)
            pen.text((x, y), name, _RED, font)
        pen.text((_PANEL * panel + 10, 8), title, "black", font)
    return canvas


def _pixels(
    positions: Float[Array, "k 3"], middle: Float[Array, "3"], reach: float, panel: int
) -> list[tuple[float, float]]:
    """Project upright positions along the vertical into panel 0, or along a horizontal into panel 1."""
    scaled = ((positions - middle)[:, [0, 1 + panel]] / reach).clip(-1, 1) * (_PANEL / 2 - _MARGIN)
    return [(_PANEL * (panel + 0.5) + x, _PANEL / 2 - y) for x, y in scaled.tolist()]


def _extent(centers: Float[Array, "n 3"], dots: Float[Array, "m 3"]) -> tuple[Float[Array, "3"], float]:
    """Return the middle and half side of a cube with nearly all cameras and points. A few of them may lie
    anywhere, and would shrink the rest to a dot."""
    ends = [np.percentile(part, [3, 97], axis=0) for part in (centers, dots) if len(part)]
    low, high = np.min(ends, axis=(0, 1)), np.max(ends, axis=(0, 1))
    return (low + high) / 2, max(float((high - low).max()) * 0.55, 1e-9)
