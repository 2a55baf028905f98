"""UserError: an error in data or settings that the user can fix."""

from __future__ import annotations

import struct
import unicodedata

DAMAGE = (
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError),
    *(MemoryError, AssertionError, struct.error),
)
"""Exceptions raised on reading values that a damaged file doesn't have."""


class UserError(Exception):
    """An error in the user's data or settings; the message names it and the remedy.

    Commands print the message alone, without a traceback.
    """

    def __str__(self) -> str:
        return printable(super().__str__())


def printable(text: str) -> str:
    """The text with control characters and lone surrogates escaped: a file's name may hold commands for the
    terminal. Line breaks and tabs stay."""
    return "".join(c if c in "\n\t" or not _commands(c) else repr(c)[1:-1] for c in text)


def in_a_line(error: BaseException, most: int = 200) -> str:
    """The beginning of another library's error, or its kind if it says nothing."""
    return " ".join(str(error).split())[:most] or type(error).__name__


def is_plain(text: str) -> bool:
    """Whether a text holds neither control characters nor lone surrogates, nor line breaks."""
    return not any(map(_commands, text))


def _commands(character: str) -> bool:
    return unicodedata.category(character) in ("Cc", "Cs")
