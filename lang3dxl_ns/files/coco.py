"""Labels in COCO's format: masks of texts and of single things in photos."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array
from scipy.ndimage import find_objects, label

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import read_json, write_atomically
from lang3dxl_ns.words.taught_words import run_lengths

OURS = {"description": "Matches in a scene of lang3dxl-ns"}
"""What files that are ours, and so may be replaced, begin to say as their `info`."""
_LEAST_PART = 1e-4
"""Share of a photo below which a separate part of a mask is no label."""


def check_labels_file(path: Path) -> None:
    """Raise UserError if labels can't be written to a path, or would replace what we didn't write, such as
    labels that a person drew."""
    if path.suffix != ".json" or path.is_dir():
        raise UserError(f"labels are written as JSON: {path} is not the name of a .json file")
    if path.is_file() and path.stat().st_size:
        with readable(f"{path} would be replaced, and is not ours", "choose another name, or move it"):
            expect(is_ours(read_json(path, 1 << 31)), "a person may have drawn it")


def is_ours(content: Mapping[str, Any]) -> bool:
    """Return whether we wrote labels or a catalog of things. Their pixels are those of undistorted photos."""
    catalog = {"things", "relations", "heights"} <= {*content}  # earlier ones had no info
    return catalog or str(dict(content.get("info") or {}).get("description")).startswith(OURS["description"])


class CocoLabels:
    """A data set in COCO's format, with an annotation for each connected part of each mask."""

    def __init__(self, categories: Sequence[str]) -> None:
        self.content: dict[str, Any] = {
            "info": {"description": f"{OURS['description']}, drawn on the undistorted photos"},
            "images": [],
            "annotations": [],
            "categories": [{"id": i, "name": name} for i, name in enumerate(categories, start=1)],
        }
        """Content of the COCO file."""

    def add(self, photo: str, masks: Sequence[Bool[Array, "h w"]]) -> None:
        """Add a photo by name, with one mask per category, at the size of the photo's file."""
        height, width = masks[0].shape
        self.add_photo(photo, (width, height))
        for category, mask in enumerate(masks, start=1):
            numbers, _ = label(mask)
            for number, place in enumerate(find_objects(numbers), start=1):
                part = numbers[place] == number
                if np.count_nonzero(part) >= _LEAST_PART * mask.size:
                    self.add_label(category, part, place)

    def add_photo(self, photo: str, size: tuple[int, int]) -> None:
        """Add a photo by name, with width and height of its file. Labels that are added next are on it."""
        images = self.content["images"]
        images.append({"id": len(images) + 1, "file_name": photo, "width": size[0], "height": size[1]})

    def add_label(
        self, category: int, part: Bool[Array, "r c"], place: tuple[slice, slice], **more: float
    ) -> None:
        """Add a label of a category (from 1): a part of the photo, by its mask and the rows and columns that
        this fills, in pixels of the file. more: further fields of the annotation."""
        image, annotations = self.content["images"][-1], self.content["annotations"]
        size, (rows, columns) = (image["height"], image["width"]), place
        box = [columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start]
        labeled = {"id": len(annotations) + 1, "image_id": image["id"], "category_id": category}
        outline = {"size": [*size], "counts": _runs(part, place, size)}
        found = {"segmentation": outline, "area": int(np.count_nonzero(part)), "bbox": box, "iscrowd": 0}
        annotations.append({**labeled, **found, **more})

    def write(self, path: Path) -> None:
        """Write the COCO file, atomically."""
        write_atomically(path, json.dumps(self.content) + "\n")


def _runs(part: Bool[Array, "r c"], place: tuple[slice, slice], size: tuple[int, ...]) -> list[int]:
    """Return the `run_lengths` of a mask of this size with one part at a place, from its columns alone."""
    (rows, columns), (height, width) = place, size
    runs = run_lengths(np.pad(part, ((rows.start, height - rows.stop), (0, 0))))
    runs[0] += height * columns.start
    runs += [0] * (len(runs) % 2 == 0)
    runs[-1] += height * (width - columns.stop)
    return runs if runs[-1] else runs[:-1]
