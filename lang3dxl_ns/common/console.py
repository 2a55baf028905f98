"""Console output: progress bars and plain lines."""

from __future__ import annotations

import io
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import contextmanager
from functools import cache, partial
from typing import TypeVar

from lang3dxl_ns.common.errors import printable

Item = TypeVar("Item")
QUIET_S = 5.0
"""Seconds before a progress bar appears. Shorter work shows none."""


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[..., None]]:
    """Yield a function to call after each of `total` items, or with their number after several. After five
    seconds, it shows a progress bar with the time left."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    bar = Progress(*columns, speed_estimate_period=600)  # items come in batches: a short window would jump
    shown = bar.add_task(what, total=total)

    timer = threading.Timer(QUIET_S, bar.start)  # a first item of minutes shows the bar, too
    timer.daemon = True
    timer.start()

    try:
        yield partial(bar.advance, shown)
    finally:
        timer.cancel()
        timer.join()
        if bar.live.is_started:  # otherwise it would print an empty line
            bar.stop()


def tracked(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items one by one under `progress`. `total` is their number, for those without a length."""
    with progress(what, len(items) if isinstance(items, Sized) else total or 0) as advance:
        for item in items:
            yield item
            advance()


def say(*lines: str) -> None:
    """Print lines verbatim: no rich markup, no wrapping, no control characters."""
    from rich import get_console

    for line in lines:
        get_console().print(printable(line), markup=False, highlight=False, soft_wrap=True)


say_once = cache(say)
"""Like `say`, but once per process."""


def accept_any_console() -> None:
    """Make characters that the terminal's encoding lacks appear escaped instead of raising an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def silence_libraries() -> None:
    """Silence the known warnings and progress bars of other libraries that a user can do nothing about."""
    for message in _KNOWN_WARNINGS:
        warnings.filterwarnings("ignore", message)
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")


_KNOWN_WARNINGS = (
    r"`torch\.jit\.\w+` is deprecated",  # torchmetrics
    r"`torch\.cuda\.amp\.",  # nerfstudio's trainer and activations
    r"Detected call of `lr_scheduler\.step\(\)` before",  # nerfstudio's optimizers
    r"Converting a tensor with requires_grad=True to a scalar",  # nerfstudio's writer
    r"Image size \(\d+ pixels\) exceeds limit",  # Pillow, of photos that phones take
    r"(Possibly c|C)orrupt EXIF data|Palette images with Transparency",  # Pillow
)
"""Patterns for the beginnings of warnings that are silenced."""


def some(names: Sequence[str], shown: int = 10) -> str:
    """Join the first few names for a message."""
    return printable(", ".join(names[:shown])).replace("\n", "\\n") + (", …" if len(names) > shown else "")


def gigabytes(size: float) -> str:
    """Format a size in bytes in a suitable unit, kB to GB."""
    unit, name = next(((u, n) for u, n in ((1e9, "GB"), (1e6, "MB")) if size >= u), (1e3, "kB"))
    return f"{size / unit:.2f} {name}"
