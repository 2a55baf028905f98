"""Ground truth in its layouts: pictures of masks in a folder per category, or polygons in JSON.

HolyScenes (HaLo-NeRF, Dudai et al. 2024) has <category>/NNNN-gt.jpg, black on white, beside copies
NNNN-img.jpg of the photos. Plain masks are <prompt>/<photo>.png, white on black; a folder images/ may hold
the photos. LERF-OVS (LangSplat's labels of LERF's scenes) and PT-OVS have one file per photo,
label/<scene>/<photo>.json: `{"info": {"width", "height"}, "objects": [{"category", "bbox": [left, top, right,
bottom], "segmentation": [[x, y], …]}, …]}`, in pixels. Several objects may share a category.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from PIL import Image, ImageDraw

from lang3dxl_ns.common.checks import expect, is_coordinate
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.common.pictures import NoPictureError, gray_values, open_picture

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Suffixes of pictures, lower case."""
_MASK, _PHOTO = "-gt", "-img"
_SLACK = 0.02
"""Share of a side by which hand-drawn outlines may exceed the photo. They are clipped to it."""


@dataclass(frozen=True)
class Truth:
    """Ground truth of a category in a photo, at the size of a map."""

    mask: Bool[Array, "h w"]
    """True on the object."""
    boxes: Float[Array, "n 4"] | None = None
    """Left, top, right and bottom in pixels of the mask, edges included; None if the labels have no boxes."""


def read_gray(
    path: Path, what: str = "ground truth", values: Callable[[Image.Image], Image.Image] = gray_values
) -> Image.Image:
    """Read a picture as gray values 0…255. Raises UserError if it cannot be read."""
    problem, damage = f"{what} {path} can't be read", (OSError, NoPictureError)
    with readable(problem, "replace or remove it", damage), open_picture(path) as image:
        return values(image)


def check_shape(path: Path, mine: tuple[int, int], other: tuple[int, int]) -> None:
    """Check that two sizes (height, width) differ by a factor, within a rounded pixel, or raise UserError."""
    (height, width), (other_height, other_width) = mine, other
    difference = abs(width * other_height - height * other_width)
    if difference > max(0.01 * height * other_width, height, width):
        raise UserError(
            f"{path} has {width} × {height} pixels, but is compared with a picture of {other_width} × "
            f"{other_height}, another aspect ratio: it belongs to another photo, or was cropped or rotated"
        )


# ── masks ─────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class MaskFile:
    """Annotation stored as a picture, of the photo's size or in proportion to it."""

    path: Path
    dark: bool = False
    """Whether the object is dark on bright instead of bright on dark."""

    def size(self) -> tuple[int, int]:
        """Read height and width in pixels. Raises UserError for an unreadable file."""
        return self._read().size[::-1]

    def truth(self, size: tuple[int, int]) -> Truth:
        """Resize the mask as gray values, then threshold it at half, so that JPEG noise does not matter."""
        image = self._read()
        check_shape(self.path, image.size[::-1], size)
        gray = np.asarray(image.resize(size[::-1], Image.Resampling.BILINEAR))
        return Truth(gray < 128 if self.dark else gray >= 128)

    def _read(self) -> Image.Image:
        image = read_gray(self.path, values=partial(gray_values, behind=255 if self.dark else 0))
        if not self.dark and image.getextrema()[1] == 1:
            raise UserError(f"ground truth {self.path} holds only 0 and 1, which look black: save 0 and 255")
        return image


def is_holyscenes(folder: Path) -> bool:
    """Return whether the folder is a scene in HolyScenes' layout."""
    return any(path.stem.endswith(_MASK) for path in folder.glob("*/*"))


def read_holyscenes(folder: Path) -> dict[str, dict[str, MaskFile]]:
    """Read the masks of a scene in HolyScenes' layout. Raises UserError for a folder without masks, also a
    category's, and for a photo without its mask."""
    if not is_holyscenes(folder):
        deeper = next(folder.glob(f"**/*{_MASK}.*"), None)
        hint = f"; there are masks in {deeper.parent}: pass the folder above that" if deeper else ""
        raise UserError(
            f"{folder} holds no HolyScenes ground truth, NNNN-gt.jpg (object black on white) in a folder per "
            f"category, for the photo NNNN.jpg{hint}"
        )
    found = {}
    for category, pictures in _categories(folder):
        masks = [(p.stem.removesuffix(_MASK), p) for p in pictures if p.stem.endswith(_MASK)]
        found[category.name] = _by_photo(category, masks, dark=True)
        for path in pictures:
            if path.stem.endswith(_PHOTO) and path.stem.removesuffix(_PHOTO) not in found[category.name]:
                mask = path.with_name(path.name.replace(_PHOTO, _MASK))
                raise UserError(f"there is {path}, but no {mask}: add the mask, or remove the photo")
    return found


def read_plain(folder: Path) -> dict[str, dict[str, MaskFile]]:
    """Read the plain masks of a scene. Raises UserError for a folder without masks, also a prompt's."""
    found = {}
    for category, pictures in _categories(folder):
        if category.name != "images":
            masks = [(path.relative_to(category).with_suffix("").as_posix(), path) for path in pictures]
            found[category.name] = _by_photo(category, masks)
    if not found:
        raise UserError(
            f"{folder} holds no ground truth: make a folder for each prompt, and in it a mask for each photo "
            f"(white on black), named like the photo"
        )
    return found


def _categories(folder: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Yield the folders of categories with their pictures at any depth, sorted, without hidden ones."""
    for category in sorted(folder.iterdir()):
        if category.is_dir() and not category.name.startswith("."):
            found = (path for path in category.rglob("*") if path.suffix.lower() in PICTURES)
            yield category, sorted(p for p in found if p.is_file() and not p.name.startswith("."))


def _by_photo(category: Path, masks: list[tuple[str, Path]], dark: bool = False) -> dict[str, MaskFile]:
    if not masks:
        raise UserError(f"{category} holds no mask: add one, or remove this category's folder")
    found: dict[str, MaskFile] = {}
    for photo, path in masks:
        if photo in found:
            raise UserError(f"{found[photo].path} and {path} label the same photo: remove one")
        found[photo] = MaskFile(path, dark)
    return found


# ── polygons ──────────────────────────────────────────────────────────────────────────────────────────


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
