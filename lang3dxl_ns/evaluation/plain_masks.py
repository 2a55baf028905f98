"""Ground truth as plain masks: a folder per prompt, with a mask per photo."""

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

PHOTOS = "images"
"""A folder of this name may hold the photos; it is not a category."""


def read_plain(folder: Path) -> Annotations:
    """Masks `folder`/<prompt>/<photo>.png, object white on black.

    Raises UserError for a folder without masks, and for a prompt without any.
    """
    found: dict[str, dict[str, Annotation]] = {}
    for category in category_folders(folder):
        if category.name == PHOTOS:
            continue
        masks = found.setdefault(category.name, {})
        for path in pictures_in(category):
            photo = path.relative_to(category).as_posix().removesuffix(path.suffix)
            add_annotation(masks, photo, MaskFile(path))
    if not found:
        raise UserError(
            f"{folder} holds no ground truth: make a folder for each prompt, and in it a mask for each photo "
            f"(white on black), named like the photo"
        )
    return found
