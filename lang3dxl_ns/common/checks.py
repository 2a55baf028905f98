"""Range checks of options, and remedies for operating system errors."""

from __future__ import annotations

import errno
from collections.abc import Mapping

from lang3dxl_ns.common.errors import UserError


def check_numbers(settings: object, bounds: Mapping[str, tuple[float, float]], prefix: str = "--") -> None:
    """Raises UserError for a field outside its (smallest, largest), NaN included. None passes."""
    for name, (low, high) in bounds.items():
        value = getattr(settings, name)
        if value is not None and not low <= value <= high:
            option = prefix + name.replace("_", "-")
            raise UserError(f"{option} is {value}: give a number from {low:g} to {high:g}")


def disk_trouble(error: OSError) -> str | None:
    """Message about a file that can't be read or written; None for other errors."""
    if error.errno not in _REMEDIES or error.filename is None:
        return None
    return f"{error.filename}: {error.strerror}; {_REMEDIES[error.errno]}"


_NO_SPACE = "free some space and run the same command again"
_NO_RIGHT = "choose another place, or change its permissions"
_NO_FOLDER = "name a folder, not a file or a path below one"
_REMEDIES = {
    errno.ENOSPC: _NO_SPACE,
    errno.EDQUOT: _NO_SPACE,
    errno.EROFS: _NO_RIGHT,
    errno.EACCES: _NO_RIGHT,
    errno.EPERM: _NO_RIGHT,
    errno.ENOTDIR: _NO_FOLDER,
    errno.EEXIST: _NO_FOLDER,
    errno.EISDIR: "name a file, not a folder",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOENT: "it does not exist; correct the name",
    errno.ELOOP: "its links lead in a circle; remove them",
    errno.EIO: "the disk or network share does not answer; restore it",
    errno.ESTALE: "the share does not answer; mount it again",
}
