"""Files that others name: photos of a model, and the masks and label maps that go with them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from lang3dxl_ns.errors import UserError


def inside(folder: Path, name: str, follow_links: bool = False) -> Path:
    """The path of a file that a model or a list names, which may lie in sub-folders of `folder`.

    Models come from other people: a name may not lead out of the folder, be it with `..`, as an absolute
    path, or through a symbolic link (unless links are to be followed). The folder itself may be a link.
    Raises UserError for a name that does.
    """
    path = folder / name
    if not name or "\0" in name or os.path.isabs(name) or ".." in Path(name).parts:
        raise UserError(f"{name!r} leads out of {folder}: names are relative to that folder, without ..")
    if not follow_links and not path.resolve().is_relative_to(folder.resolve()):
        raise UserError(
            f"{path} is a link that leads out of {folder}, to {path.resolve()}: copy the file there, or, "
            "where you trust the links, pass `lang3dxl-colmap --follow-links True` after all other options"
        )
    return path


def companion(folder: Path, name: str, suffixes: Sequence[str], follow_links: bool = False) -> Path | None:
    """The file in `folder` that goes with a photo: `name` with a suffix appended (COLMAP's photo.jpg.png,
    which also tells photo.jpg from photo.png), or with another suffix. None where there is none.

    Raises UserError for a name that leads out of the folder.
    """
    path = inside(folder, name, follow_links=True)  # the photo's own name; what is found is looked at below
    candidates = [path.with_name(path.name + suffix) for suffix in suffixes]
    candidates += [path.with_suffix(suffix) for suffix in suffixes]
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    return None if found is None else inside(folder, str(found.relative_to(folder)), follow_links)


def named_folder(choice: str, data: Path, option: str) -> Path:
    """The folder that an option names, relative to the data. Raises UserError when there is none."""
    folder = data / Path(choice).expanduser()
    if not folder.is_dir():
        raise UserError(
            f"--pipeline.datamanager.{option} {choice}: there is no folder {folder}; give one that exists "
            "(relative to the data folder, or absolute), or one of the words that --help lists"
        )
    return folder
