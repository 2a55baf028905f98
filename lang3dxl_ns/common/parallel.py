"""Parallel work on many items: in this process, in several processes, or on a Ray cluster.

Scheduling is left to Python's process pool or to Ray.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from typing import Any, Protocol, TypeAlias, TypeVar

import torch

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import data_option

PATIENCE_S = 30.0
"""Seconds to wait for a named Ray cluster to answer."""
Item = TypeVar("Item")
Result = TypeVar("Result")
Start: TypeAlias = Callable[[str], Callable[[Item], Result]]
"""Function that loads everything for the work onto a device, once per worker, and returns the work function.
It can be sent to another process."""


class Workers(Protocol):
    """Settings of workers."""

    @property
    def engine(self) -> str:
        """Where they run: "local" or "ray"."""

    @property
    def workers(self) -> int:
        """Number of workers."""

    @property
    def address(self) -> str | None:
        """Address of the Ray cluster; None starts one here."""


def run(
    config: Workers, start: Start[Item, Result], items: Sequence[Item], device: str
) -> Iterator[tuple[Item, Result]]:
    """Yield every item with its result, as they finish, from the configured workers. Raises the exceptions of
    the work, and UserError if a process dies; earlier results are kept."""
    if config.engine == "ray":
        yield from _run_on_ray(config, start, items, device)
    elif config.workers > 1 and len(items) > 1:
        yield from _run_in_processes(config.workers, start, items, device)
    else:
        work = start(device)
        for item in items:
            yield item, work(item)


_work: Any = None
"""Work function of this worker process."""


def _run_in_processes(count: int, start: Start[Item, Result], items: Sequence[Item], device: str):
    context = get_context("spawn")  # a forked process can't use CUDA
    turn = context.Value("i", 0)
    how = start, device, count, turn
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start, initargs=how)
    try:
        futures = {pool.submit(_do, item): item for item in items}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool as error:
        raise UserError(
            f"one of the {count} processes died, perhaps because memory ran out: what they have made is "
            f"kept; run the same command again, with fewer {data_option('workers')}. A script has to start "
            'processes below if __name__ == "__main__"'
        ) from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _start(start: Start, device: str, count: int, turn: Any) -> None:
    """Set up a process for the work on its device, one of the GPUs, or a share of the CPU's cores."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent handles it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with turn.get_lock():
        number, turn.value = turn.value, turn.value + 1
    if device.startswith("cuda"):
        device = f"cuda:{number % torch.cuda.device_count()}"
    else:
        torch.set_num_threads(max(torch.get_num_threads() // count, 1))
    global _work
    _work = start(device)


def _end_with_parent() -> None:
    """Exit when the parent is killed, instead of waiting forever."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _do(item: Any) -> Any:
    return _work(item)


class _Actor:
    """Worker on a Ray cluster. If it dies, Ray starts another and repeats its item."""

    def __init__(self, start: Start, device: str) -> None:
        self._work = start(device)

    def do(self, item: Any) -> tuple[Any, Any]:
        return item, self._work(item)


def _run_on_ray(config: Workers, start: Start[Item, Result], items: Sequence[Item], device: str):
    try:
        import ray
        from ray.util import ActorPool
    except ImportError as error:
        raise UserError("the engine ray needs a package: pip install -e '.[ray]'") from error
    started = not ray.is_initialized()
    if started:
        _connect(ray, config)
    try:
        resources = {"num_gpus": 1} if device.startswith("cuda") else {"num_cpus": 1}
        remote: Any = ray.remote(_Actor)
        actor = remote.options(max_restarts=-1, max_task_retries=-1, **resources)
        pool: Any = ActorPool([actor.remote(start, device) for _ in range(config.workers)])
        yield from pool.map_unordered(lambda worker, item: worker.do.remote(item), items)
    finally:
        if started:
            ray.shutdown()


def _connect(ray: Any, config: Workers) -> None:
    """Connect to the Ray cluster within the time limit, after which the attempt stays in a daemon thread, or
    start one here. Raises UserError if there is no answer."""
    # A cluster started here listens on this machine only.
    options = {"num_cpus": config.workers, "include_dashboard": False, "_node_ip_address": "127.0.0.1"}
    if config.address:
        say(f"connecting to the Ray cluster at {config.address}: {PATIENCE_S:.0f} s at most")
        options = {"address": config.address}
    answer: Future[None] = Future()

    def connect() -> None:
        try:
            answer.set_result(ray.init(log_to_driver=False, **options))
        except BaseException as error:
            answer.set_exception(error)  # raised below

    if config.address:
        threading.Thread(target=connect, daemon=True).start()
    else:
        connect()  # in this thread, with which Ray's processes end
    try:
        answer.result(PATIENCE_S)
    except Exception as error:
        if answer.done():
            ray.shutdown()  # of what it has started
        reason = error if answer.done() else f"no answer within {PATIENCE_S:.0f} s"
        raise UserError(
            f"no Ray cluster answers at {config.address or 'this machine'} ({reason}): give "
            f"{data_option('address')}, or start one with `ray start --head`"
        ) from error
