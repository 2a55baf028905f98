"""Training steps alone, and beside programs that never rest: medians in ms, in turns.

    python -m lab.benchmarks.busy FOLDER --loops 2 --turns 3

Colors alone are trained, in a process of its own each time, for 100 iterations.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter

from lang3dxl_ns.training.fit import Run, Settings, fit

STEPS, WARM = 100, 20
"""Iterations, and those that aren't counted."""


def step_ms(data: Path) -> float:
    """Train on a scene's photos at half size; return the median duration of an iteration in ms."""
    from lang3dxl_ns.scene.capture import open_capture

    settings, times, iterate = Settings.of("lang3dxl", STEPS), list[float](), Run.iterate
    settings.targets.clip, settings.photo_scale = "none", 0.5

    def timed(run: Run, step: int) -> None:
        start = perf_counter()
        iterate(run, step)
        times.append(perf_counter() - start)

    Run.iterate = timed  # type: ignore[method-assign, assignment]
    with TemporaryDirectory() as out:
        fit(open_capture(data), settings, Path(out), Path(out) / "cache", "cpu")
    return 1e3 * median(times[WARM:])


@contextmanager
def _beside(loops: int) -> Iterator[None]:
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(loops)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def main() -> None:
    """Print the medians of each turn, and of their ratio."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("--loops", type=int, default=2)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--once", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.once:
        return print(f"step {step_ms(options.data):.2f}")
    command = [sys.executable, "-m", "lab.benchmarks.busy", str(options.data), "--once"]

    def measured() -> float:
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        return float(said.rpartition("step ")[2])

    ratios = []
    for _ in range(options.turns):
        alone = measured()
        with _beside(options.loops):
            busy = measured()
        ratios.append(busy / alone)
        print(f"alone {alone:.1f} ms, busy {busy:.1f} ms", flush=True)
    print(f"busy over alone: {median(ratios):.2f}")


if __name__ == "__main__":
    main()
