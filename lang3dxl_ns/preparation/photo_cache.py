"""Cache of decoded photos and their targets, bounded in memory, with several threads that read ahead."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from torch import Tensor

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError

PATIENCE_S = (1.0, 5.0, 15.0)
"""Seconds to wait before each retry for a file that has vanished; a network share may have dropped out."""


class PhotoCache:
    """Cache that keeps the first decoded photos that fit into `max_bytes`, and reads the others ahead, in a
    number of threads (`readers`), in the order of use. `read` reads a photo's data by its key; a `patient`
    cache waits for files that have vanished.

    Photos come in shuffled rounds, and each round uses every photo once. So a cache of the latest ones would
    hardly ever hit, while photos that are kept for good hit in proportion to their number.
    """

    def __init__(
        self, read: Callable[[Any], dict[str, Any]], max_bytes: float, readers: int = 4, patient: bool = True
    ) -> None:
        self._read, self._free, self._patient = read, max_bytes, patient
        self._kept: dict[Hashable, dict[str, Any]] = {}
        self._ahead: dict[Hashable, Future[dict[str, Any]]] = {}
        self._pool = ThreadPoolExecutor(readers, thread_name_prefix="photo-reader")

    def get(self, key: Hashable, upcoming: Sequence[Hashable]) -> dict[str, Any]:
        """Return a photo's data, with retries if its file has vanished; start reading `upcoming`."""
        for each in (key, *upcoming):
            if each not in self._kept and each not in self._ahead:
                self._ahead[each] = self._pool.submit(self._read, each)
        data = self._kept[key] if key in self._kept else self._patiently(key)
        for each in self._ahead.keys() - set(upcoming):
            self._ahead.pop(each).cancel()
        if key not in self._kept:
            size = sum(value.nbytes for value in data.values() if isinstance(value, Tensor))
            if size <= self._free:
                self._kept[key], self._free = data, self._free - size
        return dict(data)

    def _patiently(self, key: Hashable) -> dict[str, Any]:
        """Wait for a photo's data, with retries if its files have vanished."""
        for seconds in PATIENCE_S if self._patient else ():
            try:
                return self._ahead[key].result()
            except UserError as reason:
                if not has_vanished(reason):
                    raise
                say(f"{reason}; retrying in {seconds:.0f} s")
            time.sleep(seconds)
            self._ahead[key] = self._pool.submit(self._read, key)
        return self._ahead[key].result()


def has_vanished(reason: UserError) -> bool:
    """Return whether a file was missing or its disk did not answer; errors in its content have no errno (nor
    has safetensors' error for a missing file)."""
    cause = reason.__cause__
    return isinstance(cause, FileNotFoundError) or (isinstance(cause, OSError) and cause.errno is not None)
