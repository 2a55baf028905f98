"""OpenMP's waiting threads: they sleep soon, so that a machine with other work doesn't slow training.

torch's threads spin at the end of every parallel region. On a busy machine a spinning thread burns the time
slice for which its sibling waits: steps took up to 20 times as long. OpenMP reads the setting when it loads.
"""

from __future__ import annotations

import os
import sys

_SPINS = "GOMP_SPINCOUNT"
_CHOICES = (_SPINS, "OMP_WAIT_POLICY")
"""Variables by which users choose how threads wait. Either one is respected."""
_SHORT = "1000"
"""Spins before a thread sleeps; docs/lab/speed.md compares others."""
_METHODS = ("lang3dxl", "lang3dxl-paper")


def sleep_soon() -> None:
    """Let OpenMP's threads sleep after a short spin. Where torch is already loaded, the setting comes too
    late: `ns-train` then starts once more with it, and other programs keep their own."""
    if not sys.platform.startswith("linux") or any(name in os.environ for name in _CHOICES):
        return
    if "torch" not in sys.modules:
        os.environ[_SPINS] = _SHORT
    elif _is_training_command(sys.argv, sys.orig_argv):
        sys.stdout.flush()
        sys.stderr.flush()
        variables = {"PYTHONWARNINGS": "ignore::FutureWarning"} | os.environ | {_SPINS: _SHORT}  # said once
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], variables)


def _is_training_command(words: list[str], started_with: list[str]) -> bool:
    """Return whether this process was started as `ns-train` with one of our methods. Programs that imitate
    its command line in `sys.argv`, such as tests and notebooks, were started with another one."""
    named = len(words) > 1 and words[1] in _METHODS
    program = os.path.basename(words[0]) if words else ""
    return named and program in ("ns-train", "train.py") and started_with[-len(words) + 1 :] == words[1:]
