"""Choice between compiled numba kernels, the default on the CPU, and torch."""

from __future__ import annotations

import functools
import os

import torch
from torch import Tensor

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError, in_a_line

VARIABLE = "LANG3DXL_CPU_KERNELS"
"""Environment variable that disables the compiled kernels if it is "torch", as in the tests."""
MOST_SUMS = 512 * 2**20
"""Most bytes of the sums that threads keep apart in a backward pass; large scenes use fewer threads."""


def takes_kernels(tensor: Tensor) -> bool:
    """Return whether the compiled kernels are available, enabled, and suit a tensor's device and number type.
    Raises UserError if the environment variable has another value than "numba" and "torch"."""
    wanted = os.environ.get(VARIABLE, "numba")
    if wanted not in ("numba", "torch"):
        raise UserError(f"{VARIABLE} is {wanted!r}: set it to numba or torch, or unset it")
    fits = tensor.device.type == "cpu" and tensor.dtype in (torch.float32, torch.float64)
    return wanted == "numba" and fits and numba_works()


@functools.cache
def numba_works() -> bool:
    """Return whether numba is installed and compiles; report one that is broken, as by another numpy."""
    try:
        import numba

        from lang3dxl_ns.common import jit

        if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]  # Python itself would take hours
            raise RuntimeError("NUMBA_DISABLE_JIT is set")
        jit.successor(0)
    except Exception as error:  # of any kind, depending on the mismatch
        if not (isinstance(error, ModuleNotFoundError) and error.name == "numba"):
            say(f"numba does not work ({in_a_line(error)}): torch takes its place, 2 to 4 times slower")
        return False
    return True
