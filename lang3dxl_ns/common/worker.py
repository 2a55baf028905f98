"""Background thread that runs only the latest submitted job."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Worker:
    """Thread that runs jobs one at a time. A new job replaces one that is still waiting, so a text box can
    submit a delayed job per keystroke, and only the last one runs. `failed` is called with a job's error."""

    def __init__(self, name: str, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._changed = threading.Condition()
        self._waiting: tuple[float, Callable[[], None]] | None = None
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def submit(self, job: Callable[[], None], delay: float = 0.0) -> None:
        """Run a job after `delay` seconds, unless another is submitted before."""
        with self._changed:
            self._waiting = time.monotonic() + delay, job
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._waiting is None or self._waiting[0] > time.monotonic():
                    self._changed.wait(None if self._waiting is None else self._waiting[0] - time.monotonic())
                job, self._waiting = self._waiting[1], None
            try:
                job()
            except Exception as error:
                self._failed(error)
