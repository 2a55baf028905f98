"""Cache of decoded photos and their targets, bounded in memory, with several threads that read ahead."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from torch import Tensor

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError

PATIENCE_S = (1.0, 5.0, 15.0)
"""Seconds to wait before each retry for a file that has vanished; a network share may have dropped out."""


class PhotoCache:
    """Cache that keeps the first decoded photos that fit into `max_bytes`, and reads the others ahead, in a
    number of threads (`readers`), in the order of use. `read` reads a photo's data by its index.

    Photos come in shuffled rounds, and each round uses every photo once. So a cache of the latest ones would
    hardly ever hit, while photos that are kept for good hit in proportion to their number.
    """

    def __init__(self, read: Callable[[int], dict[str, Any]], max_bytes: float, readers: int = 4):
        self._read = read
        self._free = max_bytes
        self._kept: dict[int, dict[str, Any]] = {}
        self._ahead: dict[int, Future[dict[str, Any]]] = {}
        self._pool = ThreadPoolExecutor(readers, thread_name_prefix="photo-reader")

    def get(self, index: int, upcoming: list[int]) -> dict[str, Any]:
        """Return the photo at `index`, with retries if its file has vanished; start reading `upcoming`."""
        for i in (index, *upcoming):
            if i not in self._kept and i not in self._ahead:
                self._ahead[i] = self._pool.submit(self._read, i)
        data = self._kept[index] if index in self._kept else self._patiently(index)
        for i in self._ahead.keys() - set(upcoming):
            self._ahead.pop(i).cancel()
        if index not in self._kept:
            size = sum(value.nbytes for value in data.values() if isinstance(value, Tensor))
            if size <= self._free:
                self._kept[index], self._free = data, self._free - size
        return dict(data)

    def _patiently(self, index: int) -> dict[str, Any]:
        """Wait for a photo's data, with retries if its files have vanished."""
        for seconds in PATIENCE_S:
            try:
                return self._ahead[index].result()
            except UserError as reason:
                if not has_vanished(reason):
                    raise
                say(f"{reason}; retrying in {seconds:.0f} s")
            time.sleep(seconds)
            self._ahead[index] = self._pool.submit(self._read, index)
        return self._ahead[index].result()


def has_vanished(reason: UserError) -> bool:
    """Return whether a file was missing or its disk did not answer; errors in its content have no errno (nor
    has safetensors' error for a missing file)."""
    cause = reason.__cause__
    return isinstance(cause, FileNotFoundError) or (isinstance(cause, OSError) and cause.errno is not None)
