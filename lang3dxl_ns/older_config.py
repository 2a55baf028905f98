"""Configurations that an earlier version wrote: what they lack takes its default, and is named."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE


class ReadsOlder:
    """For configuration dataclasses. nerfstudio keeps them in config.yml as their attributes, so an option
    that is newer than the file would be missing where it is first used."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Called when a config.yml is read (and for a copy, which lacks nothing)."""
        self.__dict__.update(state)
        known = {f.name: f for f in fields(self)}  # type: ignore[arg-type]
        missing = [f for name, f in known.items() if name not in state and f.init]
        for f in missing:
            if f.default is not MISSING:
                self.__dict__[f.name] = f.default
            elif f.default_factory is not MISSING:
                self.__dict__[f.name] = f.default_factory()
        unknown = [name for name in state if name not in known]
        if missing or unknown:
            what = [f"{f.name} = {self.__dict__.get(f.name)!r} (new)" for f in missing]
            what += [f"{name} (gone, no longer heeded)" for name in unknown]
            CONSOLE.print(
                f"The configuration is of another version ({type(self).__name__}): {', '.join(what)}",
                markup=False,
                soft_wrap=True,
            )
