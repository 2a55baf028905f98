"""What a label says about one photo and one category: the pixels of the object, and perhaps boxes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from PIL import Image

from lang3dxl_ns.errors import UserError

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Suffixes of pictures, in lower case."""


@dataclass(frozen=True)
class Truth:
    """A category in a photo, at the size of a map."""

    mask: Bool[Array, "h w"]
    """True on the object."""
    boxes: Float[Array, "n 4"] | None = None
    """Left, top, right, bottom in pixels of the mask, edges included; None where labels have no boxes."""


class Annotation(Protocol):
    """A category in a photo, read when it is asked for."""

    @property
    def path(self) -> Path:
        """The file that says so."""

    def size(self) -> tuple[int, int]:
        """Height and width of the photo that was labelled."""

    def truth(self, size: tuple[int, int]) -> Truth:
        """The annotation at another size (height, width). Raises UserError for one of another shape."""


Annotations = Mapping[str, Mapping[str, Annotation]]
"""By category, then by photo: its name without suffix, or the end of it."""


@dataclass(frozen=True)
class MaskFile:
    """An annotation that is a picture, as large as the photo or in proportion."""

    path: Path
    dark: bool = False
    """Whether the object is dark on bright (HolyScenes), rather than bright on dark."""

    def size(self) -> tuple[int, int]:
        """Height and width in pixels. Raises UserError for an unreadable file."""
        return self._read().size[::-1]

    def truth(self, size: tuple[int, int]) -> Truth:
        """Resized as grey values, then split at half, so that noise of JPEG has no say."""
        image = self._read()
        check_shape(self.path, image.size[::-1], size)
        grey = np.asarray(image.resize(size[::-1], Image.Resampling.BILINEAR))
        return Truth(grey < 128 if self.dark else grey >= 128)

    def _read(self) -> Image.Image:
        image = read_grey(self.path)
        if not self.dark and image.getextrema()[1] == 1:
            raise UserError(f"ground truth {self.path} holds 0 and 1, all of it black: save 0 and 255")
        return image


def read_grey(path: Path, what: str = "ground truth") -> Image.Image:
    """A picture as grey values 0…255. Raises UserError where it can't be read."""
    try:
        with Image.open(path) as image:
            return image.convert("L")
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise UserError(f"{what} {path} can't be read ({error}): replace or remove it") from error


def check_shape(path: Path, mine: tuple[int, int], other: tuple[int, int]) -> None:
    """Sizes (height, width) may differ by a factor, with a pixel's rounding; else UserError."""
    (height, width), (other_height, other_width) = mine, other
    difference = abs(width * other_height - height * other_width)
    if difference > max(0.01 * height * other_width, height, width):
        raise UserError(
            f"{path} has {width} × {height} pixels, and is compared with a picture of {other_width} × "
            f"{other_height}, which is another shape: it belongs to another photo, or was cropped or turned"
        )


def pictures_in(folder: Path) -> list[Path]:
    """Pictures at any depth, sorted; hidden files aside."""
    found = (path for path in folder.rglob("*") if path.suffix.lower() in PICTURES and path.is_file())
    return sorted(path for path in found if not path.name.startswith("."))


def category_folders(folder: Path) -> list[Path]:
    """The folders of the categories, sorted. Raises UserError where one holds no picture."""
    folders = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    for category in folders:
        if not pictures_in(category):
            raise UserError(f"{category} holds no mask: add one, or remove the folder of this category")
    return folders


def add_annotation(annotations: dict[str, Annotation], photo: str, annotation: Annotation) -> None:
    """Put it with the category's others. Raises UserError where the photo has one already."""
    if photo in annotations:
        raise UserError(f"{annotations[photo].path} and {annotation.path} label the same photo: remove one")
    annotations[photo] = annotation
