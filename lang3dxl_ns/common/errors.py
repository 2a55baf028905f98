"""UserError: an error in data or settings that the user can fix."""

from __future__ import annotations

import struct
import unicodedata
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from zipfile import BadZipFile

from lang3dxl_ns.common.memory import ran_out_of_memory

try:
    from lzma import LZMAError
except ImportError:  # a Python that was built without it unpacks no such archive
    LZMAError = BadZipFile  # type: ignore[misc, assignment]

DAMAGE = (
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError),
    *(AssertionError, struct.error, zlib.error, BadZipFile, LZMAError),
)
"""Exceptions raised when values are read that a damaged file does not have. A RuntimeError may also mean a
full memory, which `not_of_memory` tells apart."""


NO_NERFSTUDIO = (
    "this needs nerfstudio, which is not installed: pip install -e '.[nerfstudio]' in the checkout, with "
    "Python 3.10 to 3.12"
)


def misses_nerfstudio(error: BaseException) -> bool:
    """Return whether an import failed because the extra `nerfstudio` is not installed."""
    name = error.name if isinstance(error, ModuleNotFoundError) else None
    return (name or "").partition(".")[0] in ("nerfstudio", "viser")


class UserError(Exception):
    """Error in the user's data or settings. Commands print its message alone, which names the remedy."""

    def __str__(self) -> str:
        return printable(super().__str__())


@contextmanager
def readable(
    problem: str, remedy: str, errors: tuple[type[Exception], ...] = DAMAGE, most: int = 200
) -> Iterator[None]:
    """Turn errors of a damaged file into a UserError: problem (error, in `most` characters): remedy."""
    try:
        yield
    except UserError:
        raise
    except errors as error:
        not_of_memory(error)
        raise UserError(f"{problem} ({in_a_line(error, most)}): {remedy}") from error


def not_of_memory(error: BaseException) -> None:
    """Raise the error again if it means a full memory, so that no file is blamed for it."""
    if ran_out_of_memory(error):
        raise error


def printable(text: str) -> str:
    """Escape lone surrogates, and control characters but line breaks and tabs: names may steer terminals."""
    return "".join(c if c in "\n\t" or not _commands(c) else repr(c)[1:-1] for c in text)


def in_a_line(error: BaseException, most: int = 200) -> str:
    """Return the beginning of another library's error in one line, or its type if it has no message."""
    text = f"no {error}" if isinstance(error, KeyError) else str(error)
    return " ".join(text.split())[:most] or type(error).__name__


def is_plain(text: str) -> bool:
    """Return whether a text has no control characters, lone surrogates or line breaks."""
    return not any(map(_commands, text))


def _commands(character: str) -> bool:
    return unicodedata.category(character) in ("Cc", "Cs")
