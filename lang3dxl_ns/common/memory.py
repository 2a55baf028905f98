"""Memory limits, and retrying with smaller batches."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Files with a container's memory limit, which is often far below the machine's memory."""


def machine_memory() -> int:
    """Return the bytes of main memory that this process may use: the machine's, or its container's limit."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for path in map(Path, _LIMITS):
        text = path.read_text().strip() if path.is_file() else ""
        if text.isdigit():
            total = min(total, int(text))
    return total


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


_FULL = ("can't allocate memory", "not enough memory", "CUDA error: out of memory", "STATUS_ALLOC_FAILED")
"""Parts of errors of torch, CUDA and its libraries that mean a full memory."""


def ran_out_of_memory(error: BaseException) -> bool:
    """Return whether an error means that the GPU or the machine is out of memory."""
    import torch

    if isinstance(error, MemoryError | torch.cuda.OutOfMemoryError):
        return True
    return any(words in str(error) for words in _FULL)
