"""Labels in COCO's format, and run lengths of masks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array
from scipy.ndimage import find_objects, label

_LEAST_PART = 1e-4
"""Share of a photo below which a separate part of a mask is left out."""


def run_lengths(mask: Bool[Array, "h w"]) -> list[int]:
    """Return the lengths of a mask's alternating runs, column by column, beginning with the pixels outside,
    as in COCO's uncompressed RLE."""
    flat = mask.ravel(order="F")
    ends = np.flatnonzero(np.diff(flat)) + 1
    lengths = np.diff(np.concatenate([[0], ends, [flat.size]])).tolist()
    return [0, *lengths] if flat.size and flat[0] else lengths


def mask_of(lengths: Sequence[int], size: tuple[int, int]) -> Bool[Array, "h w"]:
    """Build the mask (height, width) with these `run_lengths`. Raises ValueError if the sizes differ."""
    counts = np.asarray(lengths, np.int64)
    if (counts < 0).any() or counts.sum() != size[0] * size[1]:
        raise ValueError("run lengths don't fit the size of their mask")
    return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(size, order="F")


class CocoLabels:
    """A data set in COCO's format, with an annotation for each connected part of each mask."""

    def __init__(self, categories: Sequence[str]) -> None:
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []
        self._categories = [{"id": i, "name": name} for i, name in enumerate(categories, start=1)]

    def add(self, photo: str, masks: Sequence[Bool[Array, "h w"]]) -> None:
        """Add a photo by name, with one mask per category, at the size of the photo's file."""
        image, (height, width) = len(self._images) + 1, masks[0].shape
        self._images.append({"id": image, "file_name": photo, "width": width, "height": height})
        for category, mask in enumerate(masks, start=1):
            numbers, _ = label(mask)
            for number, place in enumerate(find_objects(numbers), start=1):
                area = int(np.count_nonzero(numbers[place] == number))
                if area < _LEAST_PART * mask.size:
                    continue
                part = numbers == number
                rows, columns = place
                box = [columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start]
                labeled = {"id": len(self._annotations) + 1, "image_id": image, "category_id": category}
                outline = {"size": list(part.shape), "counts": run_lengths(part)}
                labeled |= {"segmentation": outline, "area": area, "bbox": box, "iscrowd": 0}
                self._annotations.append(labeled)

    @property
    def content(self) -> dict[str, Any]:
        """Content of the COCO file."""
        return {
            "info": {"description": "Matches in a scene of lang3dxl-ns, drawn on the undistorted photos"},
            "images": self._images,
            "annotations": self._annotations,
            "categories": self._categories,
        }
