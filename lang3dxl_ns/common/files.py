"""Files: atomic writes, safe folder names, lists of names."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
from collections.abc import Sequence
from pathlib import Path

from lang3dxl_ns.common.errors import UserError


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write to a temporary file beside `path`, then rename it, so that readers never see a partial file.

    If the process is killed, the old content remains, beside a leftover .tmp file.
    """
    make_folder(path.parent)
    temporary = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())  # otherwise a crash may leave the new name without content
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)  # instead of none, or the temporary name
        raise


def replace_durably(partial: Path, path: Path) -> None:
    """Move a finished file over another one; a loss of power leaves one of the two, whole."""
    _to_disk(partial)
    os.replace(partial, path)
    _to_disk(path.parent)


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder and its parents. Raises OSError with its name."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        error.filename = str(folder)
        raise


def slugs(texts: Sequence[str]) -> list[str]:
    """A unique folder name for each text, valid whatever the text contains."""
    found: list[str] = []
    for i, text in enumerate(texts):
        slug = re.sub(r"[^\w]+", "-", text.lower()).strip("-")[:40] or f"text-{i + 1}"
        forms = (slug, *(f"{slug}-{number}" for number in range(i + 1, 2 * len(texts) + 2)))
        found.append(next(form for form in forms if form not in found))
    return found


def read_names(path: Path) -> list[str]:
    """Photo names from a text file, one per line; blank lines and comments (#) are skipped.

    Raises UserError for a file that can't be read or is empty.
    """
    try:
        lines = path.expanduser().read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise UserError(f"the list of photos {path} can't be read ({error})") from error
    names = [name for line in lines if (name := line.partition("#")[0].strip())]
    if not names:
        raise UserError(f"the list of photos {path} is empty: write one name per line")
    return names
