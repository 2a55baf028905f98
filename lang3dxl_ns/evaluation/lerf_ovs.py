"""Ground truth in the layout of LERF-OVS (LangSplat's labels of LERF's scenes) and PT-OVS: polygons in JSON.

There is one file per photo, `label/<scene>/<photo>.json`: `{"info": {"width", "height"}, "objects":
[{"category", "bbox": [left, top, right, bottom], "segmentation": [[x, y], …]}, …]}`, in pixels. Several
objects may share a category.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from lang3dxl_ns.common.checks import expect, is_coordinate
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.evaluation.annotations import Truth, check_shape

_SLACK = 0.02
"""Share of a side by which hand-drawn outlines may exceed the photo. They are clipped to it."""


@dataclass(frozen=True)
class Outlines:
    """Objects of one category in one photo. The mask is their union; the boxes stay separate."""

    path: Path
    height: int
    width: int
    polygons: tuple[tuple[tuple[float, float], ...], ...]
    """Outlines as x, y in pixels, with the origin at the photo's top-left corner."""
    boxes: tuple[tuple[float, ...], ...]

    def size(self) -> tuple[int, int]:
        """Return height and width of the labeled photo, in pixels."""
        return self.height, self.width

    def truth(self, size: tuple[int, int]) -> Truth:
        """Fill the polygons at the labeled size, resize and threshold the mask at half, scale the boxes."""
        check_shape(self.path, self.size(), size)
        image = Image.new("L", (self.width, self.height))
        draw = ImageDraw.Draw(image)
        for polygon in self.polygons:
            draw.polygon(list(polygon), fill=255)
        mask = np.asarray(image.resize(size[::-1], Image.Resampling.BILINEAR)) >= 128
        zoom = np.array([size[1] / self.width, size[0] / self.height] * 2)
        return Truth(mask, np.array(self.boxes, dtype=np.float64).reshape(-1, 4) * zoom)


def is_lerf_ovs(folder: Path) -> bool:
    """Return whether the folder holds label files."""
    return any(folder.glob("*.json"))


def read_lerf_ovs(folder: Path) -> dict[str, dict[str, Outlines]]:
    """Read the labels of a scene, `folder`/<photo>.json. Raises UserError that names an invalid file."""
    paths = sorted(folder.glob("*.json"))
    if not paths:
        deeper = next(folder.glob("**/*.json"), None)
        hint = f"; there are some in {deeper.parent}: pass that folder" if deeper else ""
        raise UserError(f"{folder} holds no labels <photo>.json{hint}")
    found: dict[str, dict[str, Outlines]] = {}
    for path in paths:
        with readable(f"labels {path} can't be used", "fix or remove the file"):
            labels = _read_labels(path)
        for category, outlines in labels.items():
            found.setdefault(category, {})[path.stem] = outlines
    if not found:
        raise UserError(f"the labels in {folder} contain no objects: there is nothing to score")
    return dict(sorted(found.items()))


def _read_labels(path: Path) -> dict[str, Outlines]:
    """Read a photo's labels by category. Label files come from others, so everything is validated."""
    from lang3dxl_ns.scene.camera import MOST_PIXELS  # loads torch, which --help does not need

    content = read_json(path)
    height, width = (content["info"][side] for side in ("height", "width"))
    whole = all(type(side) is int and side > 0 for side in (height, width))
    expect(whole and height * width <= MOST_PIXELS, f"a photo of {width!r} × {height!r} pixels")
    found: dict[str, Outlines] = {}
    for item in content["objects"]:
        category, polygon, box = _read_object(item, height, width)
        known = found.get(category, Outlines(path, height, width, (), ()))
        found[category] = Outlines(path, height, width, (*known.polygons, polygon), (*known.boxes, box))
    return found


def _read_object(item: Any, height: int, width: int) -> tuple[str, tuple[Any, ...], tuple[float, ...]]:
    """Read name (which becomes part of a path and must stay in its folder), outline and box of an object."""
    category = item["category"].strip()
    plain = category not in ("", ".", "..") and not set(category) & set("/\\\0")
    expect(plain, f"{category!r} is not a plain name")
    outline, box = [(x, y) for x, y in item["segmentation"]], tuple(item["bbox"])
    expect(len(outline) >= 3, f"an outline of {category!r} has {len(outline)} points, but needs three")
    wrong = [value for point in (*outline, box) for value in point if not is_coordinate(value)]
    expect(not wrong, f"{wrong[:1]!r:.40} is not a coordinate")
    left, top, right, bottom = box
    in_order = left < right and top < bottom
    expect(in_order, f"a box of {category!r}, {list(box)}, is not [left, top, right, bottom]")
    for x, y in (*outline, (left, top), (right, bottom)):
        inside = abs(x / width - 0.5) <= 0.5 + _SLACK and abs(y / height - 0.5) <= 0.5 + _SLACK
        expect(inside, f"{category!r} reaches ({x:g}, {y:g}), outside the photo of {width} × {height} pixels")
    return category, tuple(outline), box
