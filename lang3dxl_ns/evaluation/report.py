"""What every benchmark shares: who measured, how long, how much memory, and a report never half written."""

import dataclasses
import gc
import json
import math
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from multiprocessing import get_context
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any, TypeVar

import torch
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from lang3dxl_ns.files import write_atomically

MEBIBYTE = 2**20
Result = TypeVar("Result")


# --- who measured ---------------------------------------------------------------------------------------


def describe_machine(device: torch.device | str = "cpu") -> str:
    """One line that says where and when figures were made: processor, cores, threads, versions, date."""
    parts = [
        _processor_name(),
        f"{os.cpu_count()} cores, {torch.get_num_threads()} thread(s) used",
        f"torch {torch.__version__}, Python {platform.python_version()}, {platform.system()}",
        date.today().isoformat(),
    ]
    device = torch.device(device)
    if device.type == "cuda":
        parts.insert(0, torch.cuda.get_device_name(device))
    return " · ".join(parts)


def _processor_name() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()


def command_line(command: str, settings: Any) -> str:
    """The command that repeats a run: `command` with a flag for each field that isn't at its default.

    Args:
        settings: a dataclass instance whose fields tyro turned into flags.
    """
    words = [command]
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        default = field.default_factory() if callable(field.default_factory) else field.default
        if value != default:
            words += _flag(field.name.replace("_", "-"), value)
    return " ".join(words)


def _flag(name: str, value: Any) -> list[str]:
    if isinstance(value, bool):
        return [f"--{name}" if value else f"--no-{name}"]
    words = [shlex.quote(str(item)) for item in _flatten(value)]
    if isinstance(value, str) and value.startswith("-"):  # would be taken for a flag of its own
        return [f"--{name}={words[0]}"]
    return [f"--{name}", *words]


def _flatten(value: Any) -> Iterable[Any]:
    if isinstance(value, tuple | list):
        for item in value:
            yield from _flatten(item)
    else:
        yield value


# --- how long, how much -------------------------------------------------------------------------------


def interleaved_times(
    candidates: Mapping[str, Callable[[], object]],
    repeats: int = 5,
    budget_seconds: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Seconds per run of each candidate, all measured in turn so that a busy machine slows all alike.

    Every candidate has one warm-up run, left out of the result (page faults can make it three times as
    long), then at least one more; once its `budget_seconds` are used up it has no others. Compare medians.

    Args:
        clock: seconds. `time.process_time` for work on one thread of a shared machine, where other
            processes would otherwise be counted too.
    """
    for work in candidates.values():
        work()
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(repeats):
        for name, work in candidates.items():
            if sum(times[name]) < budget_seconds:
                times[name].append(_seconds(work, clock))
    return times


def _seconds(work: Callable[[], object], clock: Callable[[], float]) -> float:
    synchronize()
    start = clock()
    work()
    synchronize()
    return clock() - start


def synchronize() -> None:
    """Wait until a GPU has done what it was asked, where one is in use."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def in_own_process(work: Callable[..., Result], /, *args: Any, preload: Sequence[str] = ()) -> Result:
    """What `work(*args)` returns, from a process of its own, so that its peak memory is its own.

    Without a GPU the process is a copy of one that has imported the modules of `preload`, once for all calls
    (the first call's); what has seen a GPU can't be copied. All must be picklable.

    Raises:
        BrokenProcessPool: the process was killed, most likely for want of memory.
    """
    if torch.cuda.is_available():
        context: BaseContext = get_context("spawn")
    else:
        context = get_context("forkserver")
        context.set_forkserver_preload(list(preload))
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(work, *args).result()


def peak_memory(setup: Callable[..., Callable[[], object]], *args: Any) -> int:
    """Extra bytes that `setup(*args)()` holds at its peak over what was held just before the last call.

    Measured in a fresh process, so nothing that ran before can lend it memory. Host memory, or the GPU's
    where `setup` starts one. `setup` and `args` must be picklable. Good to a few MiB; Linux and macOS.
    """
    # torch would import sympy at the first gradient.
    return in_own_process(_measure_peak, setup, args, preload=("torch", "sympy", setup.__module__))


def _measure_peak(setup: Callable[..., Callable[[], object]], args: Sequence[Any]) -> int:
    work = setup(*args)
    gc.collect()
    if torch.cuda.is_initialized():
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        return torch.cuda.max_memory_allocated() - before
    before = host_peak(reset=True)
    work()
    return host_peak() - before


def host_peak(reset: bool = False) -> int:
    """Most memory (bytes) this process has held; `reset` first forgets any peak above what it holds now."""
    if sys.platform == "linux":
        # getrusage would count the parent's peak too: Linux carries it over into a new process.
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        status = Path("/proc/self/status").read_text()
        kibibytes = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
        return int(kibibytes) * 1024
    import resource  # absent on Windows

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS


# --- the report -----------------------------------------------------------------------------------------


def progress_bar() -> Progress:
    """A rich progress bar with the time left; add one task per benchmark."""
    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    return Progress(*columns, speed_estimate_period=600)  # steps differ much: a short memory would jump about


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A markdown table; None becomes a dash."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join("–" if c is None else str(c) for c in line) + " |" for line in lines)


def write_report(folder: Path, name: str, markdown: str, data: Mapping[str, Any]) -> None:
    """Write `name`.json and `name`.md into `folder` (made if missing), each whole or not at all.

    Raises:
        ValueError: a figure is NaN or infinite, which JSON cannot hold and a report should not.
    """
    write_atomically(folder / f"{name}.json", json.dumps(data, indent=2, allow_nan=False) + "\n")
    write_atomically(folder / f"{name}.md", markdown.rstrip() + "\n")
