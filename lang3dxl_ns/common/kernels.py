"""Choice between compiled numba kernels, the default on the CPU, and torch."""

from __future__ import annotations

import functools
import importlib.util
import os

import torch
from torch import Tensor

VARIABLE = "LANG3DXL_CPU_KERNELS"
"""Environment variable: "torch" disables the compiled kernels, as in the tests."""


def takes_kernels(tensor: Tensor, wanted: str | None = None) -> bool:
    """Whether the compiled kernels are installed, enabled, and support a tensor's device and number type.

    wanted: "numba" or "torch"; None reads the environment variable.
    """
    wanted = wanted or os.environ.get(VARIABLE, "numba")
    fits = tensor.device.type == "cpu" and tensor.dtype in (torch.float32, torch.float64)
    return wanted == "numba" and fits and numba_is_installed()


@functools.cache
def numba_is_installed() -> bool:
    """Whether numba is available."""
    return importlib.util.find_spec("numba") is not None
