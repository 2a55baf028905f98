"""Files that go with photos: masks and label maps in a folder of their own, named like the photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lang3dxl_ns.errors import UserError


def companion(folder: Path, name: str, suffixes: Sequence[str]) -> Path | None:
    """The file in `folder` that goes with a photo: `name` with another suffix, or with one appended
    (COLMAP's photo.jpg.png). None where there is none."""
    path = folder / name
    candidates = [path.with_suffix(suffix) for suffix in suffixes]
    candidates += [path.with_name(path.name + suffix) for suffix in suffixes]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def named_folder(choice: str, data: Path, option: str) -> Path:
    """The folder that an option names, relative to the data. Raises UserError when there is none."""
    folder = data / Path(choice).expanduser()
    if not folder.is_dir():
        raise UserError(
            f"--pipeline.datamanager.{option} {choice}: there is no folder {folder}; give one that exists "
            "(relative to the data folder, or absolute), or one of the words that --help lists"
        )
    return folder
