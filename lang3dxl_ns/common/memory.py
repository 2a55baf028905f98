"""Memory limits, and retrying with smaller batches."""

from __future__ import annotations

import errno
import gc
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

_CGROUPS = Path("/sys/fs/cgroup")
_OWN = Path("/proc/self/cgroup")
_UNKNOWN = 8 << 30
"""Bytes that are taken for a machine's memory where the system doesn't tell."""
_LIMITS = {"": "memory.max", "memory": "memory/memory.limit_in_bytes"}
"""Files with the memory limit of a group, by the controllers that `_OWN` names: none in version 2."""


def machine_memory() -> int:
    """Return the bytes of main memory that this process may use: the machine's, or the least limit of its
    own (`ulimit -v`) and of the control groups that it is in (a container's, a service's, a batch job's)."""
    total = _UNKNOWN
    if hasattr(os, "sysconf"):  # Windows has none
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(ImportError):  # Windows has none
        import resource

        own = resource.getrlimit(resource.RLIMIT_AS)[0]
        total = total if own == resource.RLIM_INFINITY else min(total, own)
    for path in _limit_files():
        with suppress(OSError):
            text = path.read_text().strip()
            total = min(total, int(text)) if text.isdigit() else total
    return total


def _limit_files() -> Iterator[Path]:
    """Yield the files with memory limits of this process's control groups and of all groups above them."""
    lines = _OWN.read_text().splitlines() if _OWN.is_file() else []
    groups = [line.split(":", 2)[1:] for line in lines if line.count(":") >= 2]
    for controllers, group in [*groups, ["", "/"], ["memory", "/"]]:
        for name in set(controllers.split(",")) & set(_LIMITS):
            folder, _, file = _LIMITS[name].rpartition("/")
            parts = [part for part in group.split("/") if part not in ("", "..")]
            for depth in range(len(parts) + 1):
                yield _CGROUPS.joinpath(folder, *parts[:depth], file)


def with_less_memory(work: Callable[[int], T], amount: int) -> T:
    """Call `work(amount)`. Each time memory runs out, retry with half the amount, down to 1."""
    while True:
        try:
            return work(amount)
        except (RuntimeError, MemoryError) as error:
            if amount <= 1 or not ran_out_of_memory(error):
                raise
        # Outside the handler, so that the error and the tensors that its traceback keeps alive are released.
        amount = (amount + 1) // 2
        gc.collect()
        import torch

        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()


_FULL = (
    *("can't allocate memory", "not enough memory", "out of memory", "STATUS_ALLOC_FAILED"),
    *("Cannot allocate memory", "bad_alloc"),
)
"""Parts of errors of torch, CUDA and other libraries that mean a full memory."""


def ran_out_of_memory(error: BaseException) -> bool:
    """Return whether an error means that the GPU or the machine is out of memory."""
    if isinstance(error, RuntimeError):  # torch's OutOfMemoryError is one
        return any(words in str(error) for words in _FULL)
    return isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM
