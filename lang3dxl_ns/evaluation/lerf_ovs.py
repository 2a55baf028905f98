"""Ground truth in the layout of LERF-OVS (LangSplat's labels of LERF's scenes) and PT-OVS: polygons in JSON.

One file per photo, `label/<scene>/<photo>.json`:
`{"info": {"name", "width", "height"}, "objects": [{"category", "bbox": [left, top, right, bottom],
"segmentation": [[x, y], …]}, …]}`, in pixels. Several objects may share a category.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from lang3dxl_ns.common.checks import is_coordinate
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.evaluation.annotations import Annotation, Annotations, Truth, check_shape

_MOST_PIXELS = 200_000_000
_SLACK = 0.02
"""Share of a side by which hand-drawn outlines may exceed the photo; they are clipped to it."""
_Point = tuple[float, float]


@dataclass(frozen=True)
class Outlines:
    """The objects of one category in one photo: the mask is their union, the boxes stay separate."""

    path: Path
    height: int
    width: int
    polygons: tuple[tuple[_Point, ...], ...]
    """x, y in pixels, origin at the photo's top-left corner."""
    boxes: tuple[tuple[float, float, float, float], ...]

    def size(self) -> tuple[int, int]:
        """Height and width of the labeled photo, in pixels."""
        return self.height, self.width

    def truth(self, size: tuple[int, int]) -> Truth:
        """Polygons filled at the labeled size, then resized and thresholded at half; boxes scaled."""
        check_shape(self.path, self.size(), size)
        image = Image.new("L", (self.width, self.height))
        draw = ImageDraw.Draw(image)
        for polygon in self.polygons:
            draw.polygon(list(polygon), fill=255)
        mask = np.asarray(image.resize(size[::-1], Image.Resampling.BILINEAR)) >= 128
        zoom = np.array([size[1] / self.width, size[0] / self.height] * 2)
        return Truth(mask, np.array(self.boxes, dtype=np.float64).reshape(-1, 4) * zoom)


def is_lerf_ovs(folder: Path) -> bool:
    """Whether the folder holds label files."""
    return any(folder.glob("*.json"))


def read_lerf_ovs(folder: Path) -> Annotations:
    """Labels of a scene, `folder`/<photo>.json. Raises UserError naming the file for anything invalid."""
    paths = sorted(folder.glob("*.json"))
    if not paths:
        deeper = next(folder.glob("**/*.json"), None)
        hint = f"; there are some in {deeper.parent}: pass that folder" if deeper else ""
        raise UserError(f"{folder} holds no labels <photo>.json{hint}")
    found: dict[str, dict[str, Annotation]] = {}
    for path in paths:
        for category, outlines in _read_labels(path).items():
            found.setdefault(category, {})[path.stem] = outlines
    if not found:
        raise UserError(f"the labels in {folder} contain no objects: there is nothing to score")
    return dict(sorted(found.items()))


def _read_labels(path: Path) -> dict[str, Outlines]:
    """A photo's labels by category. Label files come from others, so everything is validated."""
    try:
        content = read_json(path)
        info = content["info"]
        _check_name(info["name"])
        height, width = (_side(info[side]) for side in ("height", "width"))
        if height * width > _MOST_PIXELS:
            raise ValueError(f"a photo of {width} × {height} pixels is too large")
        objects = [_read_object(item, height, width) for item in content["objects"]]
    except KeyError as error:
        raise UserError(f"labels {path} have no {error}: replace or remove the file") from error
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"labels {path} can't be used ({error}): fix or remove the file") from error
    by_category: dict[str, Outlines] = {}
    for category, polygon, box in objects:
        known = by_category.get(category, Outlines(path, height, width, (), ()))
        by_category[category] = Outlines(path, height, width, (*known.polygons, polygon), (*known.boxes, box))
    return by_category


def _read_object(item: Any, height: int, width: int) -> tuple[str, tuple[_Point, ...], Any]:
    category = item["category"]
    category = category.strip() if isinstance(category, str) else category
    _check_name(category)
    polygon = tuple((_number(x), _number(y)) for x, y in item["segmentation"])
    if len(polygon) < 3:
        raise ValueError(f"an outline of {category!r} has {len(polygon)} points, but needs three")
    left, top, right, bottom = box = tuple(_number(value) for value in item["bbox"])
    if not (left < right and top < bottom):
        raise ValueError(f"a box of {category!r}, {list(box)}, is not [left, top, right, bottom]")
    for x, y in (*polygon, (left, top), (right, bottom)):
        if not (_within(x, width) and _within(y, height)):
            raise ValueError(
                f"{category!r} reaches ({x:g}, {y:g}), outside the photo of {width} × {height} pixels"
            )
    return category, polygon, box


def _check_name(name: Any) -> None:
    """Names become parts of paths, so none may lead out of its folder."""
    if not isinstance(name, str) or name in ("", ".", "..") or any(c in name for c in "/\\\0"):
        raise ValueError(f"{name!r} is not a plain name")


def _side(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"a photo can't have a side of {value!r} pixels")
    return value


def _number(value: Any) -> float:
    if not is_coordinate(value):
        raise ValueError(f"{value!r:.40} is not a coordinate")
    return float(value)


def _within(value: float, side: int) -> bool:
    return -_SLACK * side <= value <= (1 + _SLACK) * side
