"""Ground truth in the layout of the HolyScenes benchmark (HaLo-NeRF, Dudai et al. 2024)."""

from __future__ import annotations

from pathlib import Path

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.annotations import (
    Annotation,
    Annotations,
    MaskFile,
    add_annotation,
    category_folders,
    pictures_in,
)

MASK, PHOTO = "-gt", "-img"
"""Suffixes of the file stems of a mask and of the copy of its photo."""
EXPECTED = "NNNN-gt.jpg (object black on white) in a folder per category, for the photo NNNN.jpg"


def is_holyscenes(folder: Path) -> bool:
    """Whether the folder is a scene in this layout."""
    return any(path.stem.endswith(MASK) for path in folder.glob("*/*"))


def read_holyscenes(folder: Path) -> Annotations:
    """Masks of a scene, `folder`/<category>/NNNN-gt.jpg, object black on white.

    Raises UserError for a folder without masks, a category without any, and a photo without its mask.
    """
    if not is_holyscenes(folder):
        deeper = next(folder.glob(f"**/*{MASK}.*"), None)
        hint = f"; there are masks in {deeper.parent}: pass the folder above that" if deeper else ""
        raise UserError(f"{folder} holds no HolyScenes ground truth, {EXPECTED}{hint}")
    found: dict[str, dict[str, Annotation]] = {}
    for category in category_folders(folder):
        masks: dict[str, Annotation] = {}
        pictures = pictures_in(category)
        for path in pictures:
            if path.stem.endswith(MASK):
                add_annotation(masks, path.stem.removesuffix(MASK), MaskFile(path, dark=True))
        for path in pictures:
            if path.stem.endswith(PHOTO) and path.stem.removesuffix(PHOTO) not in masks:
                mask = path.with_name(path.name.replace(PHOTO, MASK))
                raise UserError(f"there is {path}, but no {mask}: add the mask, or remove the photo")
        if not masks:
            raise UserError(f"{category} holds no mask NNNN{MASK}.jpg: add one, or remove the folder")
        found[category.name] = masks
    return found
