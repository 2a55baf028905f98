"""Selection of the settings that the help of a command shows."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import fields
from types import NoneType
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

Class = TypeVar("Class", bound=type)


def without(*names: str) -> Callable[[Class], Class]:
    """Return a dataclass decorator that takes inherited settings off the command line."""
    import tyro

    return lambda kind: _marked(_marked(kind, tyro.conf.Fixed, names), tyro.conf.Suppress, names)


def showing(*names: str) -> Callable[[Class], Class]:
    """Return a dataclass decorator that makes `--help` show these settings alone, in this order, the others
    after `--help-all`."""

    def arrange(kind: Class) -> Class:
        if not {"-h", "--help", "--help-all"} & set(sys.argv[1:]):  # tyro would not accept what it hides
            return kind
        import tyro

        own = {field.name: field for field in fields(kind)}
        others = [name for name in own if name not in names]
        arranged = {name: own[name] for name in (*names, *others)}
        type.__setattr__(kind, "__dataclass_fields__", arranged)
        _name_values(kind)
        return kind if "--help-all" in sys.argv[1:] else _marked(kind, tyro.conf.Suppress, others)

    return arrange


def _name_values(kind: type) -> None:
    """Describe the settings that may be absent by their values' kind alone: PATH instead of {None}|PATH."""
    import tyro

    hints = get_type_hints(kind, include_extras=True)
    for name in [field.name for field in fields(kind) if field.default is None]:
        bare = getattr(hints[name], "__origin__", hints[name])  # without Annotated
        kinds = [option for option in get_args(bare) if option is not NoneType]
        if len(kinds) == 1 and isinstance(kinds[0], type):
            shown = tyro.conf.arg(metavar=kinds[0].__name__.upper(), help_behavior_hint="")
            kind.__annotations__[name] = Annotated[hints[name], shown]


def _marked(kind: Class, mark: Any, names: Iterable[str]) -> Class:
    hints = get_type_hints(kind, include_extras=True)
    for name in names:
        kind.__annotations__[name] = mark[hints[name]]
    return kind


def asked_for_all(arguments: list[str]) -> list[str]:
    """Replace `--help-all` in a command's arguments by `--help`, as tyro spells it."""
    return ["--help" if argument == "--help-all" else argument for argument in arguments]
