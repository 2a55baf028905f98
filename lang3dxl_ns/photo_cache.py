"""Photos and their targets in a bounded piece of memory, read ahead of their turn."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from torch import Tensor


class PhotoCache:
    """Keeps what was read of photos up to a number of bytes, the few read ahead (in a thread) on top."""

    def __init__(self, read: Callable[[int], dict[str, Any]], max_bytes: float):
        self._read = read
        self._max_bytes = max_bytes
        self._entries: OrderedDict[int, Future[dict[str, Any]]] = OrderedDict()
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="photo-reader")

    def get(self, index: int, upcoming: list[int]) -> dict[str, Any]:
        """The photo at `index`; starts reading the `upcoming` ones."""
        for i in (index, *upcoming):
            if i not in self._entries:
                self._entries[i] = self._pool.submit(self._read, i)
            self._entries.move_to_end(i)
        data = self._entries[index].result()
        self._make_room(keep={index, *upcoming})
        return dict(data)

    @property
    def bytes(self) -> int:
        """Memory of the photos that are decoded."""
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
    """Memory of a photo that has been read; none of one that could not be (its own turn says why)."""
    if future.exception():
        return 0
    return sum(value.nbytes for value in future.result().values() if isinstance(value, Tensor))
