"""Console output: progress bars and plain lines."""

from __future__ import annotations

import errno
import io
import os
import stat
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import contextmanager, suppress
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
            with _outliving_terminals():
                bar.stop()


def tracked(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items one by one under `progress`. `total` is their number, for those without a length."""
    with progress(what, len(items) if isinstance(items, Sized) else total or 0) as advance:
        for item in items:
            yield item
            advance()


def say(*lines: str) -> None:
    """Print lines verbatim: no rich markup, no wrapping, no control characters. What the output's encoding
    lacks is escaped."""
    from rich import get_console

    console = get_console()
    for line in lines:
        shown = printable(line).encode(console.encoding, "backslashreplace").decode(console.encoding)
        with _outliving_terminals():
            console.print(shown, markup=False, highlight=False, soft_wrap=True)


say_once = cache(say)
"""Like `say`, but once per process."""


@contextmanager
def _outliving_terminals() -> Iterator[None]:
    """Go on without output if its terminal is gone, as that of a job in the background may be."""
    try:
        yield
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        leave_terminal()


def leave_terminal() -> None:
    """Discard from now on what is printed to a terminal."""
    for number in (1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(number).st_mode):
                os.dup2(os.open(os.devnull, os.O_WRONLY), number)


def accept_any_console() -> None:
    """Make characters that the terminal's encoding lacks appear escaped instead of raising an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def keep_standard_numbers() -> None:
    """Open the null device in place of a standard stream that the caller closed: a file of ours would get its
    number, and what libraries print would be written into it."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the least free number


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
