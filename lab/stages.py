"""Stages of a command whose seconds and memory are kept."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from pathlib import Path

from lab.reports import reset_host_peak
from lang3dxl_ns.common.errors import DAMAGE
from lang3dxl_ns.common.files import read_json, write_atomically
from lang3dxl_ns.common.reports import host_peak
from lang3dxl_ns.common.stages import Stages, roughly


class MeasuredStages(Stages):
    """Stages whose seconds and peak memory a file keeps, summed over interrupted commands.

    From the second one on, their announcements tell about how long everything left will take. The process's
    peak of memory is reset as each begins.
    """

    def __init__(self, shares: Mapping[str, float], path: Path) -> None:
        super().__init__(shares)
        self._path, self._spent = path, _spent(path)

    def begin(self, name: str) -> None:
        """End the present stage, if there is one, and announce and measure another."""
        super().begin(name)
        reset_host_peak()

    def end(self) -> None:
        """End the present stage, if there is one, and keep what it took."""
        if self._current is not None:
            spent = self._spent.setdefault(self._current, {"seconds": 0.0, "peak_mb": 0.0})
            spent["seconds"] += time.perf_counter() - self._start
            spent["peak_mb"] = max(spent["peak_mb"], host_peak() / 2**20)
            write_atomically(self._path, json.dumps(self._spent, indent=1))
        super().end()

    def _announcement(self, name: str) -> str:
        order = list(self._shares)
        left = order[order.index(name) :]
        done = [stage for stage in order[: -len(left)] if stage in self._spent]
        if not done:
            return super()._announcement(name)
        pace = sum(self._spent[s]["seconds"] for s in done) / sum(self._shares[s] for s in done)
        return f"{super()._announcement(name)} ({roughly(pace * sum(self._shares[s] for s in left))} left)"

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
