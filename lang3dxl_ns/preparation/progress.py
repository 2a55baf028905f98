"""What a preparation says to the person who waits for it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

QUIET_S = 5.0
"""Seconds before a bar appears: what is done sooner needs none."""


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[], None]]:
    """A function to call for each of `total`; after five seconds it shows a bar and the time left."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    start = time.monotonic()
    bar = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    shown = bar.add_task(what, total=total)

    def advance() -> None:
        bar.advance(shown)
        if time.monotonic() - start > QUIET_S:
            bar.start()  # does nothing the second time

    try:
        yield advance
    finally:
        bar.stop()


def say(*lines: str) -> None:
    """Print lines as they are, brackets included."""
    from rich import get_console

    for line in lines:
        get_console().print(line, markup=False, highlight=False, soft_wrap=True)


def some(names: Sequence[str], shown: int = 10) -> str:
    """The first few names."""
    return ", ".join(names[:shown]) + (", …" if len(names) > shown else "")
