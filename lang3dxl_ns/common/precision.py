"""Full precision inside autocast, for computations that 16 bits would ruin."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

Function = TypeVar("Function", bound=Callable[..., Any])


def in_full_precision(function: Function) -> Function:
    """Run a function outside autocast, with 16-bit tensor arguments widened to float32. This is for sums over
    thousands of pixels, differences of large numbers, and positions, which 16 bits would make wrong, not just
    imprecise. Without autocast, it changes nothing."""

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        if not (torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")):
            return function(*args, **kwargs)
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return function(*map(_widened, args), **{name: _widened(v) for name, v in kwargs.items()})

    return run  # type: ignore[return-value]


def _widened(value: Any) -> Any:
    narrow = isinstance(value, Tensor) and value.dtype in (torch.float16, torch.bfloat16)
    return value.float() if narrow else value
