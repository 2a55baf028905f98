"""Paths of files that a model or list names (photos, masks, label maps), kept inside their folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

from lang3dxl_ns.common.errors import UserError, is_plain
from lang3dxl_ns.common.files import expanded, own_folder
from lang3dxl_ns.common.options import capture_option, data_option, switched_on
from lang3dxl_ns.scene.reconstruction import REPORT

_LONGEST_NAME = 255
"""Longest file name that file systems allow, in bytes."""


def inside(folder: Path, name: str, follow_links: bool = False) -> Path:
    """Return the path in `folder` of a file that a model or a list names; sub-folders are allowed. Models
    come from other people, so a name must not lead out of the folder, be it through `..`, as an absolute
    path, or by a symbolic link (unless `follow_links`). The folder itself may be a link. Raises UserError for
    such a name, and for one that is too long."""
    path = folder / name
    if not name or "\0" in name or os.path.isabs(name) or ".." in Path(name).parts:
        raise UserError(f"{name!r} leads out of {folder}: names are relative to that folder, without ..")
    if any(len(os.fsencode(part)) > _LONGEST_NAME for part in Path(name).parts):
        raise UserError(f"{name:.40}… is too long for a file's name: {_LONGEST_NAME} bytes at most")
    target = Path(os.path.realpath(path))  # unlike resolve(), accepts links in a circle
    if not follow_links and not target.is_relative_to(os.path.realpath(folder)):
        followed = switched_on(capture_option("follow-links"))
        raise UserError(
            f"{path} is a link that leads out of {folder}, to {target}: copy it there; training follows "
            f"links with {followed}"
        )
    return path


def is_inside(folder: Path, name: str) -> bool:
    """Return whether a name is that of a file, a link or something else in the folder."""
    try:
        return os.path.lexists(inside(folder, name, follow_links=True))
    except UserError:
        return False


def is_name(name: object) -> bool:
    """Return whether this can name a photo in a folder: relative, without .. and control characters."""
    if not isinstance(name, str) or not is_plain(name):
        return False
    path = PurePosixPath(name)
    return path.name != "" and not path.is_absolute() and ".." not in path.parts


def companion(folder: Path, name: str, suffixes: Sequence[str], follow_links: bool = False) -> Path | None:
    """Find the file in `folder` that is called like a photo, with a suffix appended or replaced. COLMAP
    appends, as photo.jpg.png, which distinguishes photo.jpg from photo.png. Raises UserError for a name that
    leads out of the folder, and for a pipe or a device of that name."""
    path = inside(folder, name, follow_links=True)  # the photo's name; the file found is checked below
    candidates = [path.with_name(path.name + suffix) for suffix in suffixes]
    candidates += [path.with_suffix(suffix) for suffix in suffixes]
    found = next((path for path in candidates if path.exists() and not path.is_dir()), None)
    if found is not None and not found.is_file():
        raise UserError(f"{found} is not a regular file: replace or remove it")
    return None if found is None else inside(folder, str(found.relative_to(folder)), follow_links)


def named_folder(
    choice: str | Path, data: Path, option: str, spell: Callable[[str], str] = data_option
) -> Path:
    """Return the folder given to an option, relative to `data`. Raises UserError if it does not exist."""
    folder = data / expanded(choice)
    if not folder.is_dir():
        raise UserError(
            f"{spell(option)} {choice}: there is no folder {folder}; give an existing one "
            "(relative to the data folder, or absolute), or what --help lists"
        )
    return folder


def cache_folder(data: Path, named: Path | None) -> Path:
    """Return the folder of prepared targets: the named one, or lang3dxl_cache in the photos' folder. Raises
    UserError if the latter is a link: who made that folder would choose which files are written over."""
    if named is not None:
        return expanded(named)
    folder = data / "lang3dxl_cache"
    if folder.is_symlink():
        instead = f"{data_option('cache-dir')} {os.path.realpath(folder)}"
        raise UserError(f"{folder} is a link: remove it, or if it is yours, add {instead}")
    return folder


def work_folder(data: Path, named: Path | None) -> Path:
    """Return the folder of a reconstruction's features, matches and report in the cache. Raises UserError as
    `cache_folder` does, also for links in it but those to the photos, which are made anew."""
    return own_folder(cache_folder(data, named).absolute() / REPORT.parent, "numbered")
