"""Numba kernels: cached on disk, multi-threaded, with a message when they are compiled."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
import torch
from numba.core.event import Listener, register

from lang3dxl_ns.common.console import say


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function for each number type it is called with. It releases Python's lock. The machine code
    is cached beside the source or in the user's numba folder, or else made anew in every process."""
    try:
        compiled = numba.njit(nogil=True, error_model="numpy", cache=True)(function)
        # numba looks at the kernel's own file alone, but functions and constants are compiled in from others.
        with suppress(AttributeError):
            cache: Any = compiled._cache  # type: ignore[attr-defined]
            stored = cache._cache_file
            stored._source_stamp = stored._source_stamp, _shared_sources()
            cache._guard_against_spurious_io_errors = functools.partial(_forgiven, stored)
    except RuntimeError:  # numba raises this if there is no cache folder
        compiled = numba.njit(nogil=True, error_model="numpy")(function)
    _announcement.kernels.add(id(compiled))
    return compiled


@contextmanager
def _forgiven(stored: Any) -> Iterator[None]:
    """Empty a kernel's cache that can't be read or written, and go on: a loss of power leaves empty files."""
    try:
        yield
    except Exception:  # of any kind, from what unpickles a damaged file
        with suppress(OSError):
            stored.flush()


@functools.cache
def _shared_sources() -> str:
    """Hash the sources of the room that most kernels are in."""
    room = Path(__file__).parents[1] / "rendering"
    return hashlib.blake2b(b"".join(path.read_bytes() for path in sorted(room.glob("*.py")))).hexdigest()


class _Announcement(Listener):
    """Listener that says once per process that kernels are compiled, not when they are loaded from disk."""

    def __init__(self) -> None:
        self.kernels: set[int] = set()
        self._said = False

    def on_start(self, event: Any) -> None:
        if not self._said and id(event.data["dispatcher"]) in self.kernels:
            self._said = True
            say("Compiling the CPU kernels for this machine, once; this takes up to 20 seconds …")

    def on_end(self, event: Any) -> None:
        pass


_announcement = _Announcement()
register("numba:compile", _announcement)


@kernel
def successor(number: int) -> int:
    """Return the next number. This smallest kernel shows that numba compiles."""
    return number + 1


def in_threads(function: Callable[..., Any], parts: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Call a function with each tuple of arguments, on as many threads as torch uses, and keep the order."""
    threads = torch.get_num_threads()
    if min(threads, len(parts)) <= 1:
        return [function(*part) for part in parts]
    return list(_pool(threads).map(lambda part: function(*part), parts))


def ranges(count: int, least: int = 1) -> list[tuple[int, int]]:
    """Split a range into equal parts, as many as there are threads, of at least `least` each."""
    step = max(-(-count // torch.get_num_threads()), least)
    return [(first, min(first + step, count)) for first in range(0, count, step)]


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return the threads that all kernels share. There is one pool for each number of threads of torch."""
    return ThreadPoolExecutor(threads, thread_name_prefix="kernel")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
