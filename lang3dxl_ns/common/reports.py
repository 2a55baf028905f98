"""Measurements and reports: time, peak memory, machine description, atomic JSON and markdown."""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lang3dxl_ns.common.files import write_atomically

if TYPE_CHECKING:  # imported where it is used, because --help does not need it
    import torch


def describe_machine(device: torch.device | str = "cpu") -> str:
    """Describe where and when figures were measured: processor, cores, threads, versions, date."""
    import torch

    gpu = [torch.cuda.get_device_name(device)] if torch.device(device).type == "cuda" else []
    parts = [
        _processor_name(),
        f"{os.cpu_count()} cores, {torch.get_num_threads()} thread(s) used",
        f"torch {torch.__version__}, Python {platform.python_version()}, {platform.system()}",
        date.today().isoformat(),
    ]
    return " · ".join(gpu + parts)


def _processor_name() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()


def synchronize() -> None:
    """Wait until the GPU, if one is in use, has finished all queued work."""
    import torch

    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def host_peak() -> int:
    """Return the peak memory of this process, bytes."""
    if sys.platform == "linux":
        # getrusage would include the parent's peak, because Linux carries it over into a new process.
        status = Path("/proc/self/status").read_text()
        kibibytes = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
        return int(kibibytes) * 1024
    import resource  # absent on Windows

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add how long the enclosed block takes to `seconds`, under its name."""
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Format a markdown table. None becomes a dash."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join("–" if c is None else str(c) for c in line) + " |" for line in lines)


def write_report(folder: Path, name: str, markdown: str, data: Mapping[str, Any]) -> None:
    """Write `name`.json and `name`.md into `folder` (created if missing), each atomically. Raises ValueError
    for a figure that is NaN or infinite, which JSON cannot hold."""
    write_atomically(folder / f"{name}.json", json.dumps(data, indent=2, allow_nan=False) + "\n")
    write_atomically(folder / f"{name}.md", markdown.rstrip() + "\n")
