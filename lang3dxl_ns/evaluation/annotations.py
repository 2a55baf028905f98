"""Ground-truth annotation of one category in one photo: mask and optional boxes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.pictures import NoPictureError, open_picture

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Picture suffixes, lower case."""


@dataclass(frozen=True)
class Truth:
    """The ground truth of a category in a photo, at the size of a map."""

    mask: Bool[Array, "h w"]
    """True on the object."""
    boxes: Float[Array, "n 4"] | None = None
    """Left, top, right, bottom in pixels of the mask, edges included; None if the labels have no boxes."""


class Annotation(Protocol):
    """A category in a photo, read on demand."""

    @property
    def path(self) -> Path:
        """The file it is read from."""

    def size(self) -> tuple[int, int]:
        """Height and width of the labeled photo."""

    def truth(self, size: tuple[int, int]) -> Truth:
        """The annotation at `size` (height, width). Raises UserError for another aspect ratio."""


Annotations = Mapping[str, Mapping[str, Annotation]]
"""By category, then by photo: its name without suffix, or the end of that name."""


@dataclass(frozen=True)
class MaskFile:
    """An annotation stored as a picture, of the photo's size or in proportion."""

    path: Path
    dark: bool = False
    """Whether the object is dark on bright (HolyScenes) instead of bright on dark."""

    def size(self) -> tuple[int, int]:
        """Height and width in pixels. Raises UserError for an unreadable file."""
        return self._read().size[::-1]

    def truth(self, size: tuple[int, int]) -> Truth:
        """Resized as gray values, then thresholded at half, so that JPEG noise does not matter."""
        image = self._read()
        check_shape(self.path, image.size[::-1], size)
        gray = np.asarray(image.resize(size[::-1], Image.Resampling.BILINEAR))
        return Truth(gray < 128 if self.dark else gray >= 128)

    def _read(self) -> Image.Image:
        image = read_gray(self.path)
        if not self.dark and image.getextrema()[1] == 1:
            raise UserError(f"ground truth {self.path} holds only 0 and 1, which look black: save 0 and 255")
        return image


def read_gray(path: Path, what: str = "ground truth") -> Image.Image:
    """A picture as gray values 0…255. Raises UserError where it can't be read."""
    try:
        with open_picture(path) as image:
            return image.convert("L")
    except (OSError, NoPictureError) as error:
        raise UserError(f"{what} {path} can't be read ({error}): replace or remove it") from error


def check_shape(path: Path, mine: tuple[int, int], other: tuple[int, int]) -> None:
    """Raises UserError unless the sizes (height, width) differ only by a factor, within a rounded pixel."""
    (height, width), (other_height, other_width) = mine, other
    difference = abs(width * other_height - height * other_width)
    if difference > max(0.01 * height * other_width, height, width):
        raise UserError(
            f"{path} has {width} × {height} pixels, but is compared with a picture of {other_width} × "
            f"{other_height}, another aspect ratio: it belongs to another photo, or was cropped or rotated"
        )


def pictures_in(folder: Path) -> list[Path]:
    """Pictures at any depth, sorted, without hidden files."""
    found = (path for path in folder.rglob("*") if path.suffix.lower() in PICTURES and path.is_file())
    return sorted(path for path in found if not path.name.startswith("."))


def category_folders(folder: Path) -> list[Path]:
    """The categories' folders, sorted. Raises UserError if one holds no picture."""
    folders = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    for category in folders:
        if not pictures_in(category):
            raise UserError(f"{category} holds no mask: add one, or remove this category's folder")
    return folders


def add_annotation(annotations: dict[str, Annotation], photo: str, annotation: Annotation) -> None:
    """Add an annotation to its category. Raises UserError if the photo already has one."""
    if photo in annotations:
        raise UserError(f"{annotations[photo].path} and {annotation.path} label the same photo: remove one")
    annotations[photo] = annotation
