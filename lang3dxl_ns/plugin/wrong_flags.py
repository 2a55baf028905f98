"""Wrong flags of `ns-train` with a method of this package, named in one line instead of tyro's page."""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from typing import Any

import tyro


def name_wrong_flags(settings: Any) -> None:
    """Let tyro's next command line, which is that of a method with these settings, end with one line if it
    has a flag that does not exist. Other errors stay tyro's."""
    parse: Any = tyro.cli

    def parsed(*kinds: Any, **options: Any) -> Any:
        said = io.StringIO()
        try:
            with redirect_stderr(said):
                return parse(*kinds, **options)
        finally:
            found = re.search(r"Unrecognized options: (--[^\s,]+)", said.getvalue())
            sys.stderr.write(wrong_flag(settings, sys.argv[1:], found[1]) if found else said.getvalue())

    tyro.cli = parsed


def wrong_flag(settings: Any, words: Sequence[str], begins: str) -> str:
    """Say what is wrong with a flag of the method with these settings. `words` is the command line from the
    method's name on, and `begins` the beginning of the flag, as far as a line of tyro's has it."""
    given = next((word.partition("=")[0] for word in words if word.startswith(begins)), begins)
    flag, own = given.replace("_", "-"), set(_flags(settings))
    photos = set(_flags(settings.pipeline.datamanager.dataparser))
    if flag in own | photos:
        where = "before" if flag in own else "at the end, after"
        return f"Error: {given} belongs {where} the word lang3dxl-colmap\n"
    similar = get_close_matches(flag, sorted(own | photos), n=1)
    hint = f"did you mean {similar[0]}? " if similar else ""
    return f"Error: ns-train {words[0]} has no {given}: {hint}ns-train {words[0]} --help-all lists all\n"


def _flags(settings: Any, prefix: str = "--") -> Iterator[str]:
    """Yield the flags of settings and of those within them."""
    for name in (field.name for field in fields(settings) if field.name != "dataparser"):
        flag, value = prefix + name.replace("_", "-"), getattr(settings, name)
        nested = is_dataclass(value) and not isinstance(value, type)
        yield from _flags(value, f"{flag}.") if nested else [flag]
