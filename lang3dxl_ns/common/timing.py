"""Optional timing of named sections of a step."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

from lang3dxl_ns.common.reports import synchronize

_seconds: dict[str, list[float]] | None = None


@contextmanager
def part(name: str) -> Iterator[None]:
    """Time the enclosed block as `name`. Does nothing outside `measure()`."""
    if _seconds is None:
        yield
        return
    synchronize()
    start = time.perf_counter()
    yield
    synchronize()
    _seconds[name].append(time.perf_counter() - start)


@contextmanager
def measure() -> Iterator[dict[str, list[float]]]:
    """Collect the seconds of every enclosed `part`. Yields {name: one entry per visit}."""
    global _seconds
    _seconds = defaultdict(list)
    try:
        yield _seconds
    finally:
        _seconds = None
