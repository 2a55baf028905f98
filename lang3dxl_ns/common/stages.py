"""Stages of a long command: which one runs, the total time left, and seconds and memory of each."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import DAMAGE
from lang3dxl_ns.common.files import read_json, write_atomically
from lang3dxl_ns.common.reports import host_peak

_FIRST_ESTIMATE_S = 20.0
"""Seconds of a stage before its pace is trusted."""


class Stages:
    """Announcements of a command's stages, with an estimate of the time left for all of them.

    `shares` has the stages in order, with their usual shares of the time. The file `path` keeps their seconds
    and peak memory, summed over interrupted commands. Without it, nothing is kept, and memory is not
    measured, because that resets the process's peak.
    """

    def __init__(self, shares: Mapping[str, float], path: Path | None = None) -> None:
        self._shares, self._path = dict(shares), path
        self._spent = {} if path is None else _spent(path)
        self._current: str | None = None
        self._start, self._tenths = 0.0, -1

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Announce and measure a stage."""
        self.begin(name)
        try:
            yield
        finally:
            self.end()

    def begin(self, name: str) -> None:
        """End the present stage, if there is one, and say which one begins and, from the second on, about how
        long everything left will take."""
        self.end()
        self._current, self._start, self._tenths = name, time.perf_counter(), -1
        if self._path is not None:
            host_peak(reset=True)
        order = list(self._shares)
        place = order.index(name)
        done = [stage for stage in order[:place] if stage in self._spent]
        line = f"\n{place + 1} of {len(order)}: {name}"
        if done and self._path is not None:
            pace = sum(self._spent[s]["seconds"] for s in done) / sum(self._shares[s] for s in done)
            line += f" ({roughly(pace * sum(self._shares[s] for s in order[place:]))} left)"
        say(line)

    def end(self) -> None:
        """End the present stage, if there is one."""
        if self._current is None:
            return
        spent = self._spent.setdefault(self._current, {"seconds": 0.0, "peak_mb": 0.0})
        spent["seconds"] += time.perf_counter() - self._start
        self._current = None
        if self._path is not None:
            spent["peak_mb"] = max(spent["peak_mb"], host_peak() / 2**20)
            write_atomically(self._path, json.dumps(self._spent, indent=1))

    def progress(self, done: float) -> None:
        """Say about how long everything that is left takes, once the pace is known and at every tenth of the
        stage. `done` is the fraction of the stage, as far as this command does it."""
        elapsed = time.perf_counter() - self._start
        if self._current is None or int(10 * done) <= self._tenths or elapsed < _FIRST_ESTIMATE_S:
            return
        self._tenths = int(10 * done)
        shares = list(self._shares.values())[list(self._shares).index(self._current) :]
        ahead = sum(shares[1:]) / shares[0]
        left = elapsed / done * (1 - done + ahead)
        if self._tenths < 10:
            say(f"{self._current}: {100 * done:.0f} % done; {roughly(left)} left in all")

    def weigh(self, name: str, other: str, times: float) -> None:
        """Expect a stage to take `times` as long as another one."""
        if name in self._shares and other in self._shares:
            self._shares[name] = times * self._shares[other]

    def figures(self) -> dict[str, dict[str, float]]:
        """Return seconds and peak memory (MB) by stage."""
        return {
            kind: {name: math.ceil(10 * spent[kind]) / 10 for name, spent in self._spent.items()}
            for kind in ("seconds", "peak_mb")
        }


def _spent(path: Path) -> dict[str, dict[str, float]]:
    """Read the figures of an earlier command; none if damaged, because only an estimate needs them."""
    try:
        found = read_json(path)
        return {n: {kind: float(f[kind]) for kind in ("seconds", "peak_mb")} for n, f in found.items()}
    except DAMAGE:
        return {}


def roughly(seconds: float) -> str:
    """Format a duration in words, rounded up: "about 3 minutes"."""
    if seconds < 90:
        return f"about {10 * math.ceil(seconds / 10)} seconds"
    if seconds < 5400:
        return f"about {math.ceil(seconds / 60)} minutes"
    return f"about {seconds / 3600:.1f} hours"
