"""Times of candidates, measured in turn."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

from lang3dxl_ns.common.reports import synchronize


def interleaved_times(
    candidates: Mapping[str, Callable[[], object]],
    repeats: int = 5,
    budget_seconds: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Seconds per run of each candidate, measured in turn so that load on the machine slows all alike.

    Each candidate has one warm-up run, excluded from the result (page faults can make it three times as
    long), then at least one timed run, and more until its `budget_seconds` are used up. Compare medians.

    Args:
        clock: seconds. `time.process_time` for single-threaded work on a shared machine, to exclude other
            processes.
    """
    for work in candidates.values():
        work()
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(repeats):
        for name, work in candidates.items():
            if sum(times[name]) < budget_seconds:
                times[name].append(_seconds(work, clock))
    return times


def _seconds(work: Callable[[], object], clock: Callable[[], float]) -> float:
    synchronize()
    start = clock()
    work()
    synchronize()
    return clock() - start
