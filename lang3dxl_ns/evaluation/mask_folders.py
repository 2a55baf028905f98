"""Ground truth as pictures of masks, with a folder per category: HolyScenes' layout, or plain masks.

HolyScenes (HaLo-NeRF, Dudai et al. 2024) has <category>/NNNN-gt.jpg, black on white, beside copies
NNNN-img.jpg of the photos. Plain masks are <prompt>/<photo>.png, white on black; a folder images/ may hold
the photos.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.annotations import PICTURES, Truth, check_shape, read_gray

_MASK, _PHOTO = "-gt", "-img"


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
        image = read_gray(self.path, behind=255 if self.dark else 0)
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
