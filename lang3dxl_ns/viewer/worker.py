"""A thread that does the latest of what it is told."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Worker:
    """Does jobs in a thread of its own, one at a time; a new job takes the place of one that still waits.

    So a text box may hand in a job per keystroke, each to wait a moment: only the last is done.
    """

    def __init__(self, name: str) -> None:
        self._changed = threading.Condition()
        self._waiting: tuple[float, Callable[[], None]] | None = None
        self._busy = False
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def submit(self, job: Callable[[], None], delay: float = 0.0) -> None:
        """Do this after `delay` seconds, unless something else is handed in before."""
        with self._changed:
            self._waiting = time.monotonic() + delay, job
            self._changed.notify_all()

    def wait(self, timeout: float = 60.0) -> bool:
        """Until nothing is left to do; false where that takes longer."""
        with self._changed:
            return self._changed.wait_for(lambda: self._waiting is None and not self._busy, timeout)

    def _run(self) -> None:
        while True:
            job = self._next()
            try:
                job()
            finally:
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()

    def _next(self) -> Callable[[], None]:
        with self._changed:
            while True:
                left = None if self._waiting is None else self._waiting[0] - time.monotonic()
                if self._waiting is not None and left is not None and left <= 0:
                    job, self._waiting, self._busy = self._waiting[1], None, True
                    return job
                self._changed.wait(left)
