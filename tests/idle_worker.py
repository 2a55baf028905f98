"""Waiting until a `Worker` has no job left."""

from __future__ import annotations

import threading
import time

from lang3dxl_ns.common.worker import Worker


def idle(worker: Worker, timeout: float = 60.0) -> bool:
    """Wait until all jobs are done. Return False if that takes longer than `timeout` seconds. Jobs run one
    at a time, so a job of our own that is submitted when none waits runs after the last one."""
    end, mine = time.monotonic() + timeout, threading.Event()
    while time.monotonic() < end:
        with worker._changed:
            if worker._waiting is None:
                worker._waiting = 0.0, mine.set
                worker._changed.notify_all()
        if mine.wait(0.01):
            return True
    with worker._changed:  # leave nothing behind
        if worker._waiting == (0.0, mine.set):
            worker._waiting = None
    return False
