"""Stages of a long command: which one runs, and the total time left."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from lang3dxl_ns.common.console import say

_FIRST_ESTIMATE_S = 20.0
"""Seconds of a stage before its pace is trusted."""
_WINDOW_S = 60.0
"""Seconds over which the pace is measured: other programs come and go, and steps grow with the scene."""


class Stages:
    """Announcements of a command's stages, with an estimate of the time left for all of them.

    `shares` has the stages in order, with their usual shares of the time.
    """

    def __init__(self, shares: Mapping[str, float]) -> None:
        self._shares = dict(shares)
        self._current: str | None = None
        self._start, self._tenths = 0.0, -1
        self._recent: deque[tuple[float, float]] = deque()
        """Recent moments, each with the fraction that was done; the stage's start is the first."""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Announce a stage, and end it."""
        self.begin(name)
        try:
            yield
        finally:
            self.end()

    def begin(self, name: str) -> None:
        """End the present stage, if there is one, and announce another."""
        self.end()
        self._current, self._start, self._tenths = name, time.perf_counter(), -1
        self._recent = deque([(self._start, 0.0)])
        say(self._announcement(name))

    def _announcement(self, name: str) -> str:
        order = list(self._shares)
        return f"\n{order.index(name) + 1} of {len(order)}: {name}"

    def end(self) -> None:
        """End the present stage, if there is one."""
        self._current = None

    def progress(self, done: float, note: str = "") -> None:
        """Say about how long everything that is left takes at the pace of the last minute, once that is
        known, and at every tenth of the stage. `done` is the fraction of the stage in this command; `note`
        is said along."""
        now = time.perf_counter()
        self._recent.append((now, done))
        while len(self._recent) > 2 and now - self._recent[1][0] > _WINDOW_S:
            self._recent.popleft()
        if self._current is None or int(10 * done) <= self._tenths or now - self._start < _FIRST_ESTIMATE_S:
            return
        self._tenths = int(10 * done)
        shares = list(self._shares.values())[list(self._shares).index(self._current) :]
        ahead = sum(shares[1:]) / shares[0]
        before, done_before = self._recent[0]
        left = (now - before) / max(done - done_before, 1e-9) * (1 - done + ahead)
        if self._tenths < 10:
            state = f"{100 * done:.0f} % done" + (f", {note}" if note else "")
            say(f"{self._current}: {state}; {roughly(left)} left in all")

    def weigh(self, name: str, other: str, times: float) -> None:
        """Expect a stage to take `times` as long as another one."""
        if name in self._shares and other in self._shares:
            self._shares[name] = times * self._shares[other]


def roughly(seconds: float) -> str:
    """Format a duration in words, rounded up: "about 3 minutes"."""
    if seconds < 90:
        return f"about {10 * math.ceil(seconds / 10)} seconds"
    if seconds < 5400:
        return f"about {math.ceil(seconds / 60)} minutes"
    return f"about {seconds / 3600:.1f} hours"
