"""Foreground masks in a folder, found by the names that programs give them."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.pictures import PHOTO_SUFFIXES
from lang3dxl_ns.scene.companions import inside
from lang3dxl_ns.scene.names import normal_parts

FOLDERS = (Path("masks"), Path("mask"))
_MARKS = ("_mask", "-mask", ".mask", " mask", "_seg")
"""What programs append to a photo's name."""
_Key = tuple[str, ...]


class MaskFolder:
    """Masks of a folder, a picture of any format for each photo.

    The mask of photo.jpg is photo.jpg.png or photo.png, in any picture format, with or without a word like
    `_mask` before or after an ending, in the same sub-folder as the photo or in none.
    """

    def __init__(self, folder: Path, follow_links: bool = False) -> None:
        self.folder, self._follow_links = folder, follow_links

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

    @property
    def count(self) -> int:
        """Number of pictures in the folder."""
        return len({file for files in self._files.values() for file in files})

    @cached_property
    def _files(self) -> dict[_Key, list[str]]:
        """Files by the names that a photo of theirs may have."""
        found: dict[_Key, list[str]] = {}
        for parent, _, files in os.walk(self.folder, followlinks=self._follow_links):
            for file in files:
                name = Path(parent, file).relative_to(self.folder).as_posix()
                *folders, last = normal_parts(name)
                for form in _forms(last):
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


def _rank(file: str) -> int:
    """Order masks of one photo: lossless pictures first."""
    lower = file.lower()
    return next((i for i, end in enumerate((".png", ".jpg", ".jpeg")) if lower.endswith(end)), 3)


def mask_folder(data: Path, named: Path | None, follow_links: bool = False) -> MaskFolder | None:
    """Return the folder of masks: `named` (relative to `data`), or where that is the usual one and does not
    exist, another usual one; None if there is none."""
    folders = FOLDERS if named in FOLDERS else (named,)
    found = (data / folder for folder in folders if folder is not None)
    return next((MaskFolder(folder, follow_links) for folder in found if folder.is_dir()), None)


def find_mask(folder: Path, name: str, follow_links: bool = False) -> Path | None:
    """Find one photo's mask in a folder, as `MaskFolder.find` does."""
    return MaskFolder(folder, follow_links).find(name)
