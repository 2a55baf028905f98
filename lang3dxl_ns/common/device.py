"""Device and precision: choice of a device, copies that do not wait for a GPU, float32 inside autocast."""

from __future__ import annotations

import functools
import glob
import shutil
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError

_INSTALL = "https://pytorch.org/get-started/locally"
Moved = TypeVar("Moved", bound=Tensor)
Function = TypeVar("Function", bound=Callable[..., Any])


def to_device(tensor: Moved, device: torch.device | str) -> Moved:
    """Copy a tensor to a device. Unlike `Tensor.to`, a copy to a GPU does not wait for the work queued there.
    The source may be changed at once, because CUDA stages ordinary memory before it returns."""
    return tensor.to(device, non_blocking=torch.device(device).type == "cuda")  # type: ignore[return-value]


def best_device() -> str:
    """Return "cuda" if torch can use a GPU, else "cpu". In the latter case, warn if there is a GPU."""
    if torch.cuda.is_available():
        return "cuda"
    warn_of_unused_gpu()
    return "cpu"


def known_device(device: torch.device | str | int | None = None) -> torch.device:
    """Return the device to compute on, by default the best. Raises UserError for one that this machine does
    not have, and for Apple's GPUs, which lack the 64-bit numbers that cameras and words need."""
    try:
        found = torch.device(best_device() if device is None else device)
    except (RuntimeError, TypeError, ValueError) as error:
        raise UserError(f"there is no device {device!r}: give cpu, cuda or cuda:NUMBER") from error
    if found.type not in ("cpu", "cuda"):
        raise UserError(f"{found} can't compute scenes: give cpu, cuda or cuda:NUMBER")
    if found.type == "cuda" and not torch.cuda.is_available():
        raise UserError(f"{unused_gpu() or 'torch finds no GPU here'}: give cpu")
    if found.type == "cuda" and (found.index or 0) >= torch.cuda.device_count():
        raise UserError(f"there is no {found}: this machine has {torch.cuda.device_count()} GPUs")
    return found


@functools.cache
def warn_of_unused_gpu() -> None:
    """Say once per process if this machine has a GPU that torch cannot use."""
    if (trouble := unused_gpu()) is not None:
        say(f"Warning: {trouble}. Everything runs on the CPU now, many times slower.")


def unused_gpu() -> str | None:
    """Say why torch cannot use this machine's GPU, with the remedy; None if it can, or if there is no GPU."""
    if torch.cuda.is_available():
        return None
    nvidia = bool(shutil.which("nvidia-smi") or glob.glob("/dev/nvidia[0-9]*"))
    if nvidia and torch.version.cuda is None:
        built = "for AMD's" if torch.version.hip else "without CUDA"
        return f"there is an NVIDIA GPU, but this torch is built {built}: install its CUDA build ({_INSTALL})"
    if nvidia:
        return (
            f"there is an NVIDIA GPU, but torch can't use it ({_reason()}): update NVIDIA's driver, or "
            f"install the torch build for the driver's CUDA version ({_INSTALL})"
        )
    if glob.glob("/dev/kfd") and torch.version.hip is None:
        return f"there is an AMD GPU, but this torch has no ROCm: install its ROCm build ({_INSTALL})"
    return None


def _reason() -> str:
    try:
        torch.cuda.init()
    except Exception as error:
        return str(error).strip().splitlines()[0].rstrip(".")
    return "it sees no device: check CUDA_VISIBLE_DEVICES"


@functools.cache
def multiplies_bfloat16() -> bool:
    """Return whether this machine's CPU multiplies bfloat16. Elsewhere it is slower than float32."""
    try:
        from llvmlite.binding import get_host_cpu_features
    except ImportError:
        return False
    features = get_host_cpu_features()
    return bool(features.get("avx512bf16") or features.get("amx-bf16"))


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
