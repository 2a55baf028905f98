"""Selection of the settings that the help of a command shows."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import fields
from inspect import cleandoc
from types import NoneType
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

Class = TypeVar("Class", bound=type)
_MORE = "Settings that few need are listed too with --help-all."


def without(*names: str) -> Callable[[Class], Class]:
    """Return a dataclass decorator that takes inherited settings off the command line."""
    import tyro

    return lambda kind: _marked(_marked(kind, tyro.conf.Fixed, names), tyro.conf.Suppress, names)


def showing(*names: str) -> Callable[[Class], Class]:
    """Return a dataclass decorator that makes `--help` show these settings alone, in this order, the others
    after `--help-all`, which the help of a command says."""

    def arrange(kind: Class) -> Class:
        if not {"-h", "--help", "--help-all"} & set(sys.argv[1:]):  # tyro would not accept what it hides
            return kind
        import tyro

        own = {field.name: field for field in fields(kind)}
        others = [name for name in own if name not in names]
        arranged = {name: own[name] for name in (*names, *others)}
        type.__setattr__(kind, "__dataclass_fields__", arranged)
        _describe(kind)
        if "--help-all" in sys.argv[1:] or not others:
            return kind
        if hasattr(kind, "main"):
            kind.__doc__ = f"{cleandoc(kind.__doc__ or '')}\n\n{_MORE}"
        return _marked(kind, tyro.conf.Suppress, others)

    return arrange


def _describe(kind: type) -> None:
    """Describe each setting in one paragraph, and those that may be absent by their values' kind alone: PATH
    instead of {None}|PATH, or [PATH] where no flag precedes it."""
    import tyro
    from docstring_parser import parse_from_object

    hints = get_type_hints(kind, include_extras=True)
    parsed = [parse_from_object(base) for base in reversed(kind.__mro__[:-1])]
    texts = {text.arg_name: text.description for one in parsed for text in one.params}
    for field in fields(kind):
        hint, text = hints[field.name], " ".join((texts.get(field.name) or "").split())
        shown: dict[str, Any] = {"help": text or None}
        bare, marks = getattr(hint, "__origin__", hint), getattr(hint, "__metadata__", ())  # of Annotated
        kinds = [option for option in get_args(bare) if option is not NoneType]
        if field.default is None and len(kinds) == 1 and isinstance(kinds[0], type):
            name = kinds[0].__name__.upper()
            shown |= {
                "metavar": f"[{name}]" if tyro.conf.Positional in marks else name,
                "help_behavior_hint": "",
            }
        kind.__annotations__[field.name] = Annotated[hint, tyro.conf.arg(**shown)]


def _marked(kind: Class, mark: Any, names: Iterable[str]) -> Class:
    hints = get_type_hints(kind, include_extras=True)
    for name in names:
        kind.__annotations__[name] = mark[hints[name]]
    return kind


def asked_for_all(arguments: list[str]) -> list[str]:
    """Replace `--help-all` in a command's arguments by `--help`, as tyro spells it."""
    return ["--help" if argument == "--help-all" else argument for argument in arguments]
