"""Files and folders: never written half, never named so that a file system refuses; and lists of names."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Sequence
from pathlib import Path

from lang3dxl_ns.errors import UserError


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file under a temporary name beside it and rename, so that no reader ever sees a part of it.

    A process that is killed meanwhile leaves a file that ends in .tmp, and the old content.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())  # else a crash may leave the new name with no content
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def slugs(texts: Sequence[str]) -> list[str]:
    """A folder name for each text, no two the same, whatever the texts are."""
    found: list[str] = []
    for i, text in enumerate(texts):
        slug = re.sub(r"[^\w]+", "-", text.lower()).strip("-")[:40] or f"text-{i + 1}"
        found.append(f"{slug}-{i + 1}" if slug in found else slug)
    return found


def read_names(path: Path) -> list[str]:
    """Names of photos from a text file, one per line; empty lines and what follows a # are left out.

    Raises UserError for a file that can't be read, or names none.
    """
    try:
        lines = path.expanduser().read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise UserError(f"the list of photos {path} can't be read ({error})") from error
    names = [name for line in lines if (name := line.partition("#")[0].strip())]
    if not names:
        raise UserError(f"the list of photos {path} is empty: write a name on each line")
    return names
