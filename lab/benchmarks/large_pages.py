"""The page of large scenes in Chromium: bytes and seconds to picture and answer, memory, and frames.

    python -m lab.benchmarks.large_pages RUN --sizes 18000 300000 1000000 3000000
    python -m lab.benchmarks.large_pages DEMO/run --truth DEMO/scene/ground_truth

The second one tells what words lose by merging: the mean AP of each level in the held-out views. Large scenes
are copies of a trained one, side by side. WebGL runs in software here: a machine with a GPU draws frames many
times faster.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from lab.benchmarks.chromium import Counting, chromium, served
from lang3dxl_ns import load_scene
from lang3dxl_ns.evaluation.aggregate import average
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.score_scene import score_scene
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.web.levels import levels_of
from lang3dxl_ns.web.write_page import Page, write_page

WINDOWS = {"phone": (390, 844), "desk": (1440, 900)}
_WORD = "dome"
_DRAWN = """async () => {
  while ((window.lang3dxl?.view?.cost ?? 160) === 160) await new Promise((go) => setTimeout(go, 20));
}"""
_ANSWERED = f"lang3dxl.ready.then(() => lang3dxl.ask({_WORD!r})).then(() => true)"
_DRAG = """async () => {
  let frames = 0;
  lang3dxl.view.addEventListener("drawn", () => frames++);
  const start = performance.now();
  for (let k = 0; performance.now() - start < 5000; k++) {
    lang3dxl.view.camera.position.x += 1e-3 * (k % 2 ? 1 : -1);
    lang3dxl.view.wake();
    await new Promise(requestAnimationFrame);
  }
  return frames / 5;
}"""
_SETTLED = """async () => {
  for (let quiet = 0, held = 0; quiet < 10; quiet++) {
    await new Promise((go) => setTimeout(go, 500));
    const now = lang3dxl.view.parts.size;
    if (now !== held) [quiet, held] = [0, now];
  }
  return [...lang3dxl.view.parts.values()].reduce((sum, part) => sum + part.count, 0);
}"""


def tiled(scene: Scene, count: int) -> Scene:
    """Repeat a scene on a square grid until it has about this many Gaussians. Only the first copy is seen by
    photos."""
    copies = max(round(count / len(scene.splats)), 1)
    side, means = math.ceil(math.sqrt(copies)), scene.splats.means
    width = float((means.quantile(0.95, 0) - means.quantile(0.05, 0)).amax())
    up = torch.tensor([photo.pose[:3, 1].tolist() for photo in scene.photos]).mean(0)
    first, second = [axis for axis in range(3) if axis != int(up.abs().argmax())]
    cells = [(k % side - side // 2, k // side - side // 2) for k in range(copies)]
    moved = []
    for x, y in sorted(cells, key=lambda cell: math.hypot(*cell)):
        offset = means.new_zeros(3)
        offset[first], offset[second] = x * width, y * width
        moved.append(means + offset)
    repeated = scene.splats.mapped(lambda values: values.repeat(copies, *[1] * (values.dim() - 1)))
    codes = None if scene.codes is None else scene.codes.repeat(copies, 1)
    large = replace(
        scene, splats=replace(repeated, means=torch.cat(moved)), codes=codes, looks=None, cache=None
    )
    large.__dict__.update(visible=scene.visible, floating=scene.floating.repeat(copies))
    return large


def measured(browser: Any, folder: Path, window: tuple[int, int]) -> list[str]:
    """Open a page and return what it takes, as cells of a table."""
    width, height = window
    phone = width < 600
    context = browser.new_context(
        viewport={"width": width, "height": height}, has_touch=phone, is_mobile=phone
    )
    page = context.new_page()
    with served(folder) as address:
        Counting.sent, start = 0, time.perf_counter()
        page.goto(address, wait_until="commit")
        page.evaluate(_DRAWN)
        drawn, picture = Counting.sent, time.perf_counter() - start
        page.evaluate(_ANSWERED)
        answered, answer = Counting.sent, time.perf_counter() - start
        held = page.evaluate(_SETTLED)
        frames = page.evaluate(_DRAG)
        memory = page.evaluate("performance.memory.usedJSHeapSize")
    context.close()
    numbers = [drawn / 1e6, picture, answered / 1e6, answer, memory / 1e6]
    return [*(f"{number:.2f}" for number in numbers), f"{held:,}", f"{frames:.1f}"]


def print_words(scene: Scene, truth: GroundTruth) -> None:
    """Print the mean AP of a scene, and of a quarter and a sixteenth as many merged Gaussians."""
    print("| Gaussians | kB | mean AP | s to merge |\n|---|---|---|---|")
    for level in range(3):
        start = time.process_time()
        merged = levels_of(scene, len(scene.splats) // 4**level + 64).scenes[0] if level else scene
        seconds, count = time.process_time() - start, len(merged.splats)
        files = Page(merged, large=count).files()
        size = sum(len(files.get(name, b"")) for name in ("splats.bin", "codes.bin", "rows.bin"))
        figures, _ = score_scene(merged, truth, "held-out")
        words = average(list(figures.values()))["map"]
        print(f"| {count:,} | {size / 1e3:.0f} | {words:.3f} | {seconds:.1f} |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("run", type=Path)
    parser.add_argument("--sizes", type=int, nargs="+", default=[18_000, 300_000, 1_000_000, 3_000_000])
    parser.add_argument("--truth", type=Path)
    options = parser.parse_args()
    scene = load_scene(options.run)
    if options.truth is not None:
        return print_words(scene, GroundTruth(options.truth))
    print("| Gaussians | window | MB, picture | s | MB, answer | s | MB, heap | held | frames a second |")
    print("|---" * 9 + "|")
    with chromium() as browser, tempfile.TemporaryDirectory() as kept:
        for size in options.sizes:
            large, folder = tiled(scene, size), Path(kept) / str(size)
            write_page(Page(large), folder)
            for name, window in WINDOWS.items():
                cells = measured(browser, folder, window)
                print(f"| {len(large.splats):,} | {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
