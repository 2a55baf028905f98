"""Peak memory of a piece of work, measured in a process of its own."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from typing import Any

import torch

from lab.reports import in_own_process, reset_host_peak
from lang3dxl_ns.common.reports import host_peak

MEBIBYTE = 2**20


def peak_memory(setup: Callable[..., Callable[[], object]], *args: Any) -> int:
    """Bytes that `setup(*args)()` allocates at its peak, beyond what was held just before the last call.

    Measured in a fresh process, so earlier work can't distort it: host memory, or the GPU's if `setup` uses
    one. `setup` and `args` must be picklable. Accurate to a few MiB; Linux and macOS.
    """
    # sympy, because torch would otherwise import it at the first gradient.
    return in_own_process(_measure_peak, setup, args, preload=("torch", "sympy", setup.__module__))


def _measure_peak(setup: Callable[..., Callable[[], object]], args: Sequence[Any]) -> int:
    work = setup(*args)
    gc.collect()
    if torch.cuda.is_initialized():
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        return torch.cuda.max_memory_allocated() - before
    reset_host_peak()
    before = host_peak()
    work()
    return host_peak() - before
