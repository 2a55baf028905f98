"""Ctrl-C, SIGTERM and a lost terminal as a wish that work may end at a good place."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from lang3dxl_ns.common.console import leave_terminal


@contextmanager
def stoppable(stop: Callable[[signal.Signals], None]) -> Iterator[None]:
    """Call `stop` at the first Ctrl-C or SIGTERM, and when the terminal is lost, unless `nohup` ignores that;
    a second one acts at once. In other threads than the main one, which alone may handle signals, nothing
    changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # None stands for a handler that Python did not install, and cannot restore.
    before = {n: signal.getsignal(n) or signal.SIG_DFL for n in (signal.SIGINT, signal.SIGTERM)}
    lost = getattr(signal, "SIGHUP", None)  # Windows has none
    if lost is not None and signal.getsignal(lost) is not signal.SIG_IGN:
        before[lost] = signal.getsignal(lost) or signal.SIG_DFL

    def asked(number: int, _frame: FrameType | None) -> None:
        found = signal.Signals(number)
        signal.signal(number, before[found])
        if found is lost:
            leave_terminal()
        stop(found)

    for number in before:
        signal.signal(number, asked)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def end_at_once() -> None:
    """Let Ctrl-C and SIGTERM end the process without a word from now on, unless its caller ignores them. A
    command's work is then done and told, and Python's exit handlers would print a traceback below it."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
