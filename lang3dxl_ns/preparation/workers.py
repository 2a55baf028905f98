"""Parallel work on many items: in this process, in several processes, or on a Ray cluster.

Scheduling is left to Python's process pool or to Ray.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures import TimeoutError as FutureTimeoutError
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from typing import Any, Literal, Protocol, TypeVar

import torch

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError

PATIENCE_S = 30.0
"""Seconds to wait for a Ray cluster to answer."""
Item = TypeVar("Item", contravariant=True)
Result = TypeVar("Result", covariant=True)


class Maker(Protocol[Item, Result]):
    """Setup of a worker, which can be sent to another process."""

    def start(self, device: str) -> Callable[[Item], Result]:
        """Load everything for the work onto a device, once per worker, and return the work function."""


@dataclass(frozen=True)
class Workers:
    """Number and kind of workers."""

    count: int = 1
    """Number of processes."""
    engine: Literal["local", "ray"] = "local"
    """Where the processes run: on this machine, or on a Ray cluster (which must see the same folders)."""
    address: str | None = None
    """Address of the Ray cluster; None starts one on this machine."""

    def run(
        self, maker: Maker[Item, Result], items: Sequence[Item], device: str
    ) -> Iterator[tuple[Item, Result]]:
        """Yield every item with its result, as they finish. Raises the exceptions of the work, and UserError
        if a process dies; earlier results are kept."""
        if self.engine == "ray":
            return _run_on_ray(self, maker, items, device)
        if self.count <= 1 or len(items) <= 1:
            return _run_here(maker, items, device)
        return _run_in_processes(self.count, maker, items, device)


def _run_here(maker: Maker[Item, Result], items: Sequence[Item], device: str):
    work = maker.start(device)
    for item in items:
        yield item, work(item)


# --- processes of this machine ----------------------------------------------------------------------------

_work: Any = None
"""Work function of this worker process."""


def _run_in_processes(count: int, maker: Maker[Item, Result], items: Sequence[Item], device: str):
    context = get_context("spawn")  # a forked process can't use CUDA
    turn = context.Value("i", 0)
    pool = ProcessPoolExecutor(
        count, mp_context=context, initializer=_start, initargs=(maker, device, count, turn)
    )
    try:
        futures = {pool.submit(_do, item): item for item in items}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool as error:
        raise UserError(
            f"one of the {count} processes died, perhaps because memory ran out: what they have made is "
            "kept; run the same command again, with fewer --workers"
        ) from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _start(maker: Maker, device: str, count: int, turn: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent handles it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with turn.get_lock():
        number, turn.value = turn.value, turn.value + 1
    global _work
    _work = maker.start(_device(device, number, count))


def _end_with_parent() -> None:
    """Exit when the parent is killed, instead of waiting forever."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _do(item: Any) -> Any:
    return _work(item)


def _device(device: str, number: int, count: int) -> str:
    """Return the worker's device, one of the GPUs; on a CPU, take a share of the cores."""
    if device.startswith("cuda"):
        return f"cuda:{number % torch.cuda.device_count()}"
    torch.set_num_threads(max(torch.get_num_threads() // count, 1))
    return device


# --- a Ray cluster -----------------------------------------------------------------------------------------


class _Actor:
    """Worker on a Ray cluster. If it dies, Ray starts another and repeats its item."""

    def __init__(self, maker: Maker, device: str) -> None:
        self._work = maker.start(device)

    def do(self, item: Any) -> tuple[Any, Any]:
        return item, self._work(item)


def _run_on_ray(workers: Workers, maker: Maker[Item, Result], items: Sequence[Item], device: str):
    try:
        import ray
        from ray.util import ActorPool
    except ImportError as error:
        raise UserError("--engine ray needs Ray: pip install 'lang3dxl-ns[ray]'") from error
    started = not ray.is_initialized()
    if started:
        _connect(ray, workers)
    try:
        resources = {"num_gpus": 1} if device.startswith("cuda") else {"num_cpus": 1}
        remote: Any = ray.remote(_Actor)
        actor = remote.options(max_restarts=-1, max_task_retries=-1, **resources)
        pool: Any = ActorPool([actor.remote(maker, device) for _ in range(workers.count)])
        yield from pool.map_unordered(lambda worker, item: worker.do.remote(item), items)
    finally:
        if started:
            ray.shutdown()


def _within(seconds: float, job: Callable[[], Any]) -> None:
    """Run a job with a time limit. Raises TimeoutError when it is reached (the job stays in a daemon thread),
    or the job's exception."""
    ended: Future[None] = Future()

    def run() -> None:
        try:
            ended.set_result(job())
        except BaseException as error:
            ended.set_exception(error)  # raised below, in the waiting thread

    threading.Thread(target=run, daemon=True).start()
    try:
        ended.result(seconds)
    except FutureTimeoutError as error:
        raise TimeoutError(f"no answer within {seconds:.0f} s") from error


def _connect(ray: Any, workers: Workers, attempts: int = 2) -> None:
    """Connect to the Ray cluster, or start one here. Raises UserError if it doesn't answer.

    Ray allows its processes half a minute to start; a second attempt finds them in the disk cache."""
    # A cluster started here listens on this machine only.
    own = {"num_cpus": workers.count, "include_dashboard": False, "_node_ip_address": "127.0.0.1"}
    try:
        if workers.address:
            say(f"connecting to the Ray cluster at {workers.address}: {PATIENCE_S:.0f} s at most")
            _within(PATIENCE_S, lambda: ray.init(log_to_driver=False, address=workers.address))
        else:
            ray.init(log_to_driver=False, **own)
    except Exception as error:  # Ray raises this class itself if its processes don't start in time
        if not isinstance(error, TimeoutError):
            ray.shutdown()
            if attempts > 1 and not workers.address:
                return _connect(ray, workers, attempts - 1)
        raise UserError(
            f"no Ray cluster answers at {workers.address or 'this machine'} ({error}): give --address, or "
            "start one with `ray start --head`"
        ) from error
