"""Foreground masks in a folder, found by the names that programs give them."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import capture_option
from lang3dxl_ns.common.pictures import PHOTO_SUFFIXES
from lang3dxl_ns.scene.companions import inside, named_folder
from lang3dxl_ns.scene.names import normal_parts

FOLDERS = (Path("masks"), Path("mask"))
"""Usual folders, with any capitals, and with a dot or a line before them."""
_MARKS = ("_mask", "-mask", ".mask", " mask", "_seg")
"""What programs append to a photo's name."""
_Key = tuple[str, ...]


class MaskFolder:
    """Masks of a folder, a picture of any format for each photo.

    The mask of photo.jpg is photo.jpg.png or photo.png, in any picture format, with or without a word like
    `_mask` before or after an ending, in the same sub-folder as the photo or in none. In a folder that holds
    the photos as well (`beside`), a mask has such a word.
    """

    def __init__(self, folder: Path, follow_links: bool = False, beside: bool = False) -> None:
        self.folder, self._follow_links, self._beside = folder, follow_links, beside

    def find(self, photo: str) -> Path | None:
        """Find a photo's mask. Raises UserError for a photo's name that leads out of the folder, for a mask
        that is a link out of it, a pipe or a device."""
        inside(self.folder, photo, follow_links=True)
        parts = normal_parts(photo)
        stem = parts[-1].rpartition(".")[0] or parts[-1]
        for last in dict.fromkeys((parts[-1], stem)):
            for key in dict.fromkeys(((*parts[:-1], last), (last,))):
                if files := self._files.get(key):
                    return self._checked(min(files, key=lambda file: (_rank(file), len(file), file)))
        return None

    def _checked(self, file: str) -> Path:
        path = self.folder / file
        if not path.is_file():
            raise UserError(f"{path} is not a regular file: replace or remove it")
        return inside(self.folder, file, self._follow_links)

    def __bool__(self) -> bool:
        """Whether it has a picture."""
        return bool(self._files)

    @cached_property
    def _files(self) -> dict[_Key, list[str]]:
        """Files by the names that a photo of theirs may have."""
        found: dict[_Key, list[str]] = {}
        for parent, _, files in os.walk(self.folder, followlinks=self._follow_links):
            for file in files:
                name = Path(parent, file).relative_to(self.folder).as_posix()
                *folders, last = normal_parts(name)
                for form in photos_of_mask(last) if self._beside else _forms(last):
                    found.setdefault((*folders, form), []).append(name)
        return found


def _forms(last: str) -> list[str]:
    """List the names that the photo of a mask called `last` may have: photo.jpg for photo.jpg.png, for
    example. Of a name that isn't a picture's there are none."""
    ends = (*PHOTO_SUFFIXES, ".mask")
    end = next((end for end in ends if last.endswith(end) and last != end), None)
    if end is None or last.startswith("."):
        return []
    forms = [last.removesuffix(end)]
    while mark := next((mark for mark in _MARKS if forms[-1].endswith(mark) and forms[-1] != mark), None):
        forms.append(forms[-1].removesuffix(mark))
    return [*forms, *(form.removeprefix("mask_") for form in forms if form.startswith("mask_"))]


def photos_of_mask(last: str) -> list[str]:
    """List the names that the photo of a mask beside it may have; none for a name without a mask's word."""
    return _forms(last)[1:]


def _rank(file: str) -> int:
    """Order masks of one photo: lossless pictures first."""
    lower = file.lower()
    return next((i for i, end in enumerate((".png", ".jpg", ".jpeg")) if lower.endswith(end)), 3)


def mask_folder(
    data: Path, named: Path | None, follow_links: bool = False, images: Path | None = None
) -> MaskFolder | None:
    """Return the folder of masks: `named` (relative to `data`), or where that is the usual one, a usual one
    of the scene or of the photos (`images`), or the photos' folder if masks lie in it; None if there is
    none. Raises UserError if the named one does not exist."""
    if named is None:
        return None
    if named not in FOLDERS:
        return MaskFolder(named_folder(named, data, "masks-path", capture_option), follow_links)
    images = images or data
    for folder in dict.fromkeys((data, images.parent, images)):
        for path in sorted(folder.iterdir()) if folder.is_dir() else []:
            if Path(path.name.casefold().lstrip("._")) in FOLDERS and path.is_dir():
                return MaskFolder(path, follow_links)
    beside = MaskFolder(images, follow_links, beside=True)
    return beside or None
