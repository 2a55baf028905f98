"""Lazy import of pycolmap, without its side effects on the process."""

from __future__ import annotations

import signal
import threading
from types import ModuleType

import numpy  # noqa: F401 (before pycolmap: in the other order, Pillow's PNG writer aborts the process)


def load_pycolmap() -> ModuleType:
    """Import pycolmap, and restore the Python SIGTERM handler that its import replaces. pycolmap's handler
    prints a stack trace and kills the process."""
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if threading.current_thread() is threading.main_thread():  # only the main thread may handle signals
        signal.signal(signal.SIGTERM, signal.SIG_DFL if handler is None else handler)
    return pycolmap
