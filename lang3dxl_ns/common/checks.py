"""Range checks of options, and remedies for operating system errors."""

from __future__ import annotations

import errno
import socket
from collections.abc import Mapping

from lang3dxl_ns.common.errors import UserError, in_a_line

FARTHEST = 1e12
"""Largest coordinate, world units. Map coordinates are below 1e8."""


def check_numbers(settings: object, bounds: Mapping[str, tuple[float, float]], prefix: str = "--") -> None:
    """Check that fields are within (smallest, largest) or None. Raises UserError otherwise, also for NaN."""
    for name, (low, high) in bounds.items():
        value = getattr(settings, name)
        if value is not None and not low <= value <= high:
            option = prefix + name.replace("_", "-")
            raise UserError(f"{option} is {value}: give a number from {low:g} to {high:g}")


def disk_trouble(error: OSError) -> str | None:
    """Return a message about a file that cannot be read or written; None for other errors."""
    if error.errno is None:
        return None
    if error.filename is None:  # a stream has no name
        return f"the output can't be written: {error.strerror}" if error.errno == errno.ENOSPC else None
    # Systems have many more reasons than those below.
    return f"{error.filename}: {error.strerror}; {_REMEDIES.get(error.errno, _NO_USE)}"


def is_coordinate(value: object) -> bool:
    """Return whether this is a finite number of a sensible size: not NaN, a truth value or text."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < FARTHEST


def expect(holds: bool, otherwise: str) -> None:
    """Check a condition on a file's content. Raises ValueError with a reason if it does not hold."""
    if not holds:
        raise ValueError(otherwise)


def check_address(host: str, port: int | None) -> None:
    """Check that a server can use an address; a port of None stands for any. Raises UserError for a port that
    is taken or invalid, and for a host that is not a name or address of this machine."""
    if port is not None and not 1 <= port <= 65535:
        raise UserError(f"the port is {port}: give a number from 1 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port or 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do after a restart
            trial.bind(address)
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise UserError(f"port {port} is taken by another program: name another, or none") from error
        raise UserError(
            f"{host} is not an address of this machine ({in_a_line(error)}): use 127.0.0.1, or 0.0.0.0"
        ) from error


_NO_USE = "choose another place or name"
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
    errno.EFBIG: "its disk holds no file so large (FAT32: 4 GB), or `ulimit -f` allows none: choose another",
    errno.EMFILE: "allow more open files (ulimit -n 4096)",
    errno.EIO: "the disk or network share does not answer; restore it",
    errno.ESTALE: "the share does not answer; mount it again",
}
