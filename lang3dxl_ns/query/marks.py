"""Marks of an example, drawn into the views in which the scene is measured."""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.run_file import ScenePhoto
from lang3dxl_ns.query.teach import MASK_SIDE, Example, Point

MARK_SIDE = 320
"""Longer side in pixels of the views in which marks are gathered."""
_REACH = 0.01
"""Radius of a click, as a fraction of the photo's longer side."""


def marks(example: Example, photo: ScenePhoto, size: tuple[int, int]) -> Float[Tensor, "2 h w"]:
    """Compute the share of each pixel of a view (height, width) marked as the word, and as not the word.
    Marks are drawn on the photo's file, while views are undistorted. Raises UserError if marks lie outside
    the photo, or have other proportions."""
    width, height = photo.file_size
    labels = photo.photo().undistort_labels(_drawn(example, width, height))
    chosen = torch.stack([labels == 1, labels == 2]).float()
    return F.interpolate(chosen[None], size, mode="area")[0]


def _drawn(example: Example, width: int, height: int) -> Int[Tensor, "h w"]:
    """Draw 1 on the word, 2 on what is not the word, 0 elsewhere, on at most `MASK_SIDE` pixels a side."""
    if example.mask is not None:
        rows, columns = example.mask.shape
        if abs(columns * height - rows * width) > 0.01 * rows * width + max(width, height):
            raise UserError(
                f"the mask of {example.photo} has {columns} × {rows} pixels, the photo {width} × {height}: "
                "draw it on the whole photo"
            )
        labels = torch.from_numpy(example.mask.astype(np.int32))
    else:
        zoom = min(MASK_SIDE / max(width, height), 1.0)
        labels = torch.zeros(max(round(height * zoom), 1), max(round(width * zoom), 1), dtype=torch.int32)
    place = f"{example.photo} of {width} × {height} pixels"
    x, y = labels.shape[1] / width, labels.shape[0] / height
    if example.box is not None:
        left, top = max(example.box[0], 0), max(example.box[1], 0)
        right, bottom = min(example.box[2], width), min(example.box[3], height)
        if not (left < right and top < bottom):
            numbers = ", ".join(f"{x:g}" for x in example.box)
            raise UserError(f"the box {numbers} marks nothing in {place}: give left, top, right and bottom")
        across = slice(int(left * x), max(math.ceil(right * x), int(left * x) + 1))
        labels[int(top * y) : max(math.ceil(bottom * y), int(top * y) + 1), across] = 1
    for points, label in ((example.points, 1), (example.not_points, 2)):
        for column, row in points:
            if not (0 <= column <= width and 0 <= row <= height):
                raise UserError(f"the point {column:g}, {row:g} lies outside {place}")
            _draw_disk(labels, ((column + 0.5) * x, (row + 0.5) * y), label)
    return labels


def _draw_disk(labels: Int[Tensor, "h w"], center: Point, label: int) -> None:
    rows, columns = torch.meshgrid(*(torch.arange(side) + 0.5 for side in labels.shape), indexing="ij")
    radius = max(_REACH * max(labels.shape), 0.8)
    labels[(columns - center[0]) ** 2 + (rows - center[1]) ** 2 <= radius**2] = label
