"""Selection of the settings that the help of a command shows."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import fields
from typing import Any, TypeVar, get_type_hints

import tyro

Class = TypeVar("Class", bound=type)


def without(*names: str) -> Callable[[Class], Class]:
    """Return a dataclass decorator that takes inherited settings off the command line."""
    return lambda kind: _marked(kind, tyro.conf.Fixed, names)


def showing(*names: str) -> Callable[[Class], Class]:
    """Return a dataclass decorator that hides all but these settings from `--help`, not from `--help-all`."""

    def hide(kind: Class) -> Class:
        if not {"-h", "--help"} & set(sys.argv[1:]):  # tyro would not accept what it does not print
            return kind
        return _marked(kind, tyro.conf.Suppress, [f.name for f in fields(kind) if f.name not in names])

    return hide


def _marked(kind: Class, mark: Any, names: Iterable[str]) -> Class:
    hints = get_type_hints(kind, include_extras=True)
    for name in names:
        kind.__annotations__[name] = mark[hints[name]]
    return kind


def asked_for_all(arguments: list[str]) -> list[str]:
    """Replace `--help-all` in a command's arguments by `--help`, as tyro spells it."""
    return ["--help" if argument == "--help-all" else argument for argument in arguments]
