"""Cache of decoded photos and their targets, bounded in memory, with read-ahead."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from torch import Tensor

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError

PATIENCE_S = (1.0, 5.0, 15.0)
"""Seconds to wait before retrying a file that has vanished: a network share may have dropped out."""


class PhotoCache:
    """Keeps decoded photos up to a number of bytes, plus a few read ahead in a thread."""

    def __init__(self, read: Callable[[int], dict[str, Any]], max_bytes: float):
        self._read = read
        self._max_bytes = max_bytes
        self._entries: OrderedDict[int, Future[dict[str, Any]]] = OrderedDict()
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="photo-reader")

    def get(self, index: int, upcoming: list[int]) -> dict[str, Any]:
        """The photo at `index`, with retries if its file has vanished; starts reading the `upcoming`."""
        for i in (index, *upcoming):
            if i not in self._entries:
                self._entries[i] = self._pool.submit(self._read, i)
            self._entries.move_to_end(i)
        data = self._patiently(index)
        self._make_room(keep={index, *upcoming})
        return dict(data)

    def _patiently(self, index: int) -> dict[str, Any]:
        """A photo's data, with retries if its files have vanished."""
        for seconds in PATIENCE_S:
            try:
                return self._entries[index].result()
            except UserError as reason:
                if not has_vanished(reason):
                    raise
                say(f"{reason}; retrying in {seconds:.0f} s")
            time.sleep(seconds)
            self._entries[index] = self._pool.submit(self._read, index)
        return self._entries[index].result()

    @property
    def bytes(self) -> int:
        """Memory of the decoded photos."""
        return sum(_bytes(future) for future in self._entries.values() if future.done())

    def _make_room(self, keep: set[int]) -> None:
        excess = self.bytes - self._max_bytes
        for i in [i for i in self._entries if i not in keep]:
            if excess <= 0:
                return
            future = self._entries.pop(i)
            if not future.cancel():
                excess -= _bytes(future)


def _bytes(future: Future[dict[str, Any]]) -> int:
    """Memory of a decoded photo; 0 for one that could not be read (`get` raises the reason)."""
    if future.exception():
        return 0
    return sum(value.nbytes for value in future.result().values() if isinstance(value, Tensor))


def has_vanished(reason: UserError) -> bool:
    """Whether a file was missing or its disk did not answer (errors in its content have no number)."""
    return isinstance(reason.__cause__, OSError) and reason.__cause__.errno is not None
