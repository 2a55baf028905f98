"""Additions to `lang3dxl_ns.common.reports` for the laboratory: commands and memory."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import Any


def reset_host_peak() -> None:
    """Lower the peak memory of this process (`host_peak`) to its present memory, where the system can."""
    if sys.platform == "linux":
        Path("/proc/self/clear_refs").write_text("5")


def command_line(command: str, settings: Any) -> str:
    """Return the command that repeats a run: `command`, and a flag for each of the `settings` not at its
    default. `settings` is a dataclass instance whose fields tyro turned into flags."""
    words = [command]
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        default = field.default_factory() if callable(field.default_factory) else field.default
        name = field.name.replace("_", "-")
        if value == default:
            continue
        if isinstance(value, bool):
            words.append(f"--{name}" if value else f"--no-{name}")
        elif isinstance(value, str) and value.startswith("-"):  # would be parsed as a flag
            words.append(f"--{name}={shlex.quote(value)}")
        else:
            words += [f"--{name}", *_quoted(value)]
    return " ".join(words)


def _quoted(value: Any) -> list[str]:
    nested = isinstance(value, tuple | list)
    return [word for item in value for word in _quoted(item)] if nested else [shlex.quote(str(value))]
