"""Memory: how much this machine has for us, and how to do with less of it."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch

T = TypeVar("T")

_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""A container's limit, which may be far below what the machine has."""


def machine_memory() -> int:
    """Bytes of main memory that this process may count on at most: the machine's, or its container's."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for path in map(Path, _LIMITS):
        text = path.read_text().strip() if path.is_file() else ""
        if text.isdigit():
            total = min(total, int(text))
    return total


def with_less_memory(work: Callable[[int], T], amount: int) -> T:
    """`work(amount)`; whenever memory runs out, again with half of the amount at a time, down to 1."""
    while True:
        try:
            return work(amount)
        except (RuntimeError, MemoryError) as error:
            if amount <= 1 or not ran_out_of_memory(error):
                raise
        # Out here the error, which holds on to the tensors of its frames, is gone.
        amount = (amount + 1) // 2
        gc.collect()
        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()


def ran_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a GPU, or the machine, has no memory left."""
    if isinstance(error, MemoryError | torch.cuda.OutOfMemoryError):
        return True
    return "can't allocate memory" in str(error) or "not enough memory" in str(error)
