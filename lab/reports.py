"""Additions to `lang3dxl_ns.common.reports` for the laboratory: commands, own processes, memory, figures."""

from __future__ import annotations

import dataclasses
import io
import shlex
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:  # imported where it is used, so that a command's help does not load it
    from matplotlib.figure import Figure

Result = TypeVar("Result")
Settings = TypeVar("Settings")


def in_own_process(work: Callable[..., Result], /, *args: Any, preload: Sequence[str] = ()) -> Result:
    """Run `work(*args)` in its own process, so that its peak memory can be measured, and return the result.

    Without a GPU, processes are forked from one that has imported the modules `preload` of the first call.
    With a GPU, they are started anew, since a process that has used a GPU cannot be forked. The work, its
    arguments and its result must be picklable.

    Raises:
        BrokenProcessPool: the process was killed, most likely for lack of memory.
    """
    import torch

    if torch.cuda.is_available():
        context: BaseContext = get_context("spawn")
    else:
        context = get_context("forkserver")
        context.set_forkserver_preload(list(preload))
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(work, *args).result()


def reset_host_peak() -> None:
    """Lower the peak memory of this process (`host_peak`) to its present memory, where the system can."""
    if sys.platform == "linux":
        Path("/proc/self/clear_refs").write_text("5")


def with_flags(config: Settings, flags: str) -> Settings:
    """Change a configuration by flags as `ns-train` reads them: switches take True or False."""
    import tyro

    return tyro.cli(
        type(config), args=shlex.split(flags), default=config, config=(tyro.conf.FlagConversionOff,)
    )


def as_png(figure: Figure) -> bytes:
    """Render a matplotlib figure as the bytes of a PNG."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()


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
