"""Files: guarded reads, atomic writes, safe folder names, lists of names."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import re
import secrets
import shutil
import stat
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from lang3dxl_ns.common.console import gigabytes, say
from lang3dxl_ns.common.errors import UserError, readable

_MOST_BYTES = 64 << 20
"""Largest file of settings, names or figures, bytes. Files of arrays have their own limits."""
_LONGEST_PATH = 4000
"""Longest path, bytes; systems allow 4,095, and temporary files have longer names."""


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading. Raises OSError for anything else, because reading a pipe or a device
    may never end. The check is made on the opened file, so that it cannot be replaced in between."""
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    number = errno.EISDIR if path.is_dir() else errno.EINVAL
    raise OSError(number, "it is not a regular file", str(path))


def check_regular(path: Path) -> None:
    """Check, for readers of other libraries, that this is a readable regular file. Raises OSError if not."""
    open_file(path).close()


def read_text(path: Path, most: int = _MOST_BYTES) -> str:
    """Read UTF-8 text (or UTF-16 with a mark) from a regular file. Raises OSError, or ValueError for more
    than `most` bytes."""
    with open_file(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"it is larger than {most >> 20} MiB")
    # Windows' editors put a mark first, and some of its programs write two bytes per character.
    return content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")


def read_json(path: Path, most: int = _MOST_BYTES) -> Any:
    """Read the content of a JSON file. Raises OSError, or ValueError for anything that is not JSON."""
    try:
        return json.loads(read_text(path, most))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def content_digest(path: Path) -> str:
    """Compute 32 hex digits of a file's content."""
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def read_array(path: Path) -> Any:
    """Read the array of a .npy file, whose header must match the file's size. Raises OSError, or ValueError
    for anything else: other formats, pickles, and headers that announce more data than there is."""
    import numpy as np

    form = np.lib.format
    readers = {(1, 0): form.read_array_header_1_0, (2, 0): form.read_array_header_2_0}
    with open_file(path) as file:
        try:
            shape, _, kind = readers[form.read_magic(file)](file)
            size = math.prod(shape) * kind.itemsize
        except Exception as error:  # numpy evaluates headers, which may fail in any way
            raise ValueError(f"its header is no array's: {type(error).__name__}") from error
        if kind.hasobject or size != os.fstat(file.fileno()).st_size - file.tell():
            raise ValueError("its header does not fit its size")
        file.seek(0)
        return form.read_array(file, allow_pickle=False)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file that a user named, as `replace_file` does, but through a link, which stays a link. A
    device (/dev/stdout) or a pipe is written to, and never replaced by a file."""
    path = expanded(path)
    make_folder(path.parent)
    if path.exists() and not path.is_file():
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return
    replace_file(followed(path), content)


def replace_file(path: Path, content: str | bytes) -> None:
    """Write a file under a name that we chose: to a temporary file beside it, which is then renamed, so that
    readers never see a partial file. If the process is killed, the old content remains, beside a leftover
    .tmp file. A link or pipe of this name, which someone else made, is replaced and never followed. A
    replaced file keeps its mode."""
    make_folder(path.parent)
    content = content.encode() if isinstance(content, str) else content
    temporary = path.with_name(f"{path.name[:50]}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            with contextlib.suppress(OSError):  # there is none yet, or the disk has no modes
                if stat.S_ISREG((old := path.lstat()).st_mode):
                    os.chmod(temporary, stat.S_IMODE(old.st_mode))
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # otherwise a crash may leave the new name without content
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)  # otherwise it would be None or the temporary name
        raise


def own(path: Path) -> Path:
    """Return a path of ours at which we write or delete. Raises UserError for a link or pipe: who made the
    folder would choose which files that concerns."""
    if path.is_symlink() or path.is_fifo():
        raise UserError(f"{path} is a link or pipe, perhaps to files of others: remove it")
    return path


def own_folder(folder: Path, skipped: str = "") -> Path:
    """Return a folder of ours in which we write or delete. Raises UserError as `own` does, for all that is in
    it but what folders called `skipped` hold."""
    for parent, folders, files in os.walk(own(folder)):
        for name in (*folders, *files):
            own(Path(parent, name))
        folders[:] = [name for name in folders if name != skipped]
    return folder


def set_aside(path: Path) -> Path:
    """Rename a file that is not ours to overwrite to NAME.old, or NAME.old2 …, and return the new name."""
    path = followed(path)
    forms = (path.with_name(f"{path.name}.old{number or ''}") for number in (0, *range(2, 10_000)))
    kept = next(form for form in forms if not os.path.lexists(form))
    path.rename(kept)
    return kept


@contextlib.contextmanager
def locked(folder: Path, busy: str | None = None) -> Iterator[None]:
    """Hold the lock of a folder itself: unlike a lock file, it leaves nothing beside a user's files, and a
    killed process gives it up too. If another process holds it, say so and wait, or raise UserError with the
    message `busy`. Where the system has no such locks, nothing is held."""
    make_folder(folder)
    with contextlib.ExitStack() as held:
        with contextlib.suppress(ImportError, OSError):  # Windows; network disks
            import fcntl

            held.callback(os.close, descriptor := os.open(folder, os.O_RDONLY))
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                if busy:
                    raise UserError(busy) from error
                say(f"Waiting for another command that writes in {folder} …")
                fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


@contextlib.contextmanager
def file_locked(path: Path) -> Iterator[None]:
    """Hold the lock under which a file is changed: that of the folder that the file itself is in, whichever
    link names it. Wait for it like `locked`."""
    with locked(followed(path).parent):
        yield


def replace_durably(partial: Path, path: Path) -> None:
    """Move a finished file over another one. A loss of power leaves one of the two intact."""
    with partial.open("r+b") as file:  # Windows syncs no file that is open for reading alone
        os.fsync(file.fileno())
    os.replace(partial, path)
    with contextlib.suppress(OSError), contextlib.ExitStack() as held:  # shares and Windows sync no folder
        held.callback(os.close, folder := os.open(path.parent, os.O_RDONLY))
        os.fsync(folder)


def followed(path: Path) -> Path:
    """Return the place that a path leads to through links; nothing may be there yet. Raises OSError for links
    in a circle."""
    with contextlib.suppress(FileNotFoundError):
        return Path(os.path.realpath(path, strict=True))
    return Path(os.path.realpath(path))


def make_folder(folder: Path) -> None:
    """Make a folder and its parents. Raises OSError with the folder's name."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        error.filename = str(folder)
        raise


def check_room(folder: Path, needed: float, what: str, remedy: str) -> int:
    """Return a disk's free bytes. Raises UserError if what will be written to the folder needs more."""
    free = shutil.disk_usage(folder).free
    if needed > free:
        room = f"{gigabytes(needed)} in {folder}, and {gigabytes(free)} are free"
        raise UserError(f"{what} need {room}: free some space, or {remedy}")
    return free


def expanded(path: str | Path) -> Path:
    """Replace ~ in a path. Raises UserError for the home of an unknown user, and for what no path can be."""
    name = os.fsencode(path)
    if not name:
        raise UserError("a path is empty, which would be the current folder: name it, or write .")
    if b"\0" in name or len(name) > _LONGEST_PATH or any(len(part) > 255 for part in name.split(b"/")):
        begin = os.fsdecode(name[:60])
        raise UserError(f"{begin} … is not a path (too long, or a null character): choose a shorter name")
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise UserError(f"{path}: there is no such user; write the folder's whole name") from error


def absolute(path: str | Path) -> Path:
    """Expand a path, and complete it from the root on. Its last part is a name and not `..`, so that results
    can be named after it. Raises UserError as `expanded`."""
    path = expanded(path)
    return Path(os.path.realpath(path)) if ".." in path.parts else path.absolute()


def slugs(texts: Sequence[str]) -> list[str]:
    """Choose a unique folder name for each text, valid whatever the text contains."""
    found: list[str] = []
    for i, text in enumerate(texts):
        slug = re.sub(r"[^\w]+", "-", text.lower()).strip("-")[:40] or f"text-{i + 1}"
        forms = (slug, *(f"{slug}-{number}" for number in range(i + 1, 2 * len(texts) + 2)))
        found.append(next(form for form in forms if form not in found))
    return found


def read_names(path: Path, what: str = "photos", known: Collection[str] = ()) -> tuple[str, ...]:
    """Read names of photos, or other texts (`what` in messages), one per line of a file, each once. Blank
    lines and comments (#) are skipped; a # in a `known` name begins none. Raises UserError for a file that
    cannot be read or is empty."""
    with readable(f"the list of {what} {path} can't be read", "correct or replace it"):
        lines = [line.strip() for line in read_text(expanded(path)).splitlines()]
    found = (line if line in known else re.sub(r"(^|\s)#.*", "", line).strip() for line in lines)
    names = tuple(filter(None, dict.fromkeys(found)))
    if not names:
        raise UserError(f"the list of {what} {path} is empty: write one per line")
    return names
