"""`lang3dxl benchmark queries`: time from a new text to its picture, on a trained run."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import torch
import tyro

from lang3dxl_ns.common.reports import (
    command_line,
    describe_machine,
    interleaved_times,
    markdown_table,
    write_report,
)
from lang3dxl_ns.scene.camera import Camera

if TYPE_CHECKING:
    from lang3dxl_ns.query.scene import Scene

PROMPTS = ("windows", "portals", "towers", "roof")
"""Of frames; their meaning does not change the time."""
_SIZES = ("wooden", "narrow", "broken", "painted", "tall", "small", "wide", "carved", "dark", "round")
_THINGS = ("window", "gate", "stair")


@dataclass(kw_only=True)
class QueryBenchmark:
    """Time new texts and frames with heat maps on a trained run; one thread, processor time without a GPU."""

    run: tyro.conf.Positional[Path | None] = None
    """Folder of the run, or its config.yml (default: the newest under outputs/)."""
    out: Path
    """Folder for queries.md and queries.json."""
    size: tuple[int, int] = (640, 480)
    """Width and height of a frame, pixels."""
    repeats: int = 10
    """Frames of each kind, in turn."""

    def main(self) -> None:
        """Measure and write the report."""
        from lang3dxl_ns.plugin.load_scene import load_scene

        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            scene = load_scene(self.run)
            figures = self.measure(scene)
        finally:
            torch.set_num_threads(threads)
        command = command_line("lang3dxl benchmark queries", self)
        write_report(
            self.out, "queries", _markdown(figures, command, describe_machine(scene.device)), figures
        )
        print(f"Wrote {self.out / 'queries.md'}")

    def measure(self, scene: Scene) -> dict[str, float]:
        """Milliseconds of each part, and the frames' ratios to a frame of colors alone."""
        clock = time.perf_counter if scene.device.type == "cuda" else time.process_time

        def once(work) -> float:
            return 1e3 * next(iter(interleaved_times({"": work}, 1, clock=clock).values()))[0]

        start = clock()
        engine = scene.engine
        decode = 1e3 * (clock() - start)
        scene.thresholds(scene.prompts("house"))  # asks for the unrelated words, once per scene
        texts = iter([f"{size} {thing}" for thing in _THINGS for size in _SIZES])

        def new_text() -> None:
            prompts = scene.prompts(next(texts))
            engine.carried(scene.queries(prompts))
            scene.thresholds(prompts)

        text = median(once(new_text) for _ in range(len(_SIZES)))
        camera = _camera(scene.file.photos[0].camera, *self.size)
        none = torch.zeros(len(scene.gaussians["means"]), 0, device=scene.device)
        frames = {
            count: engine.carried(scene.queries(scene.prompts("; ".join(PROMPTS[:count]))))
            for count in (1, 4)
        }
        shown = {0: none} | frames
        work = {str(count): partial(scene._render, camera, carried) for count, carried in shown.items()}
        times = interleaved_times(work, self.repeats, clock=clock)
        ms = {count: 1e3 * median(values) for count, values in times.items()}
        return {
            "gaussians": len(none),
            "width": camera.width,
            "height": camera.height,
            "decode_ms": decode,
            "text_ms": text,
            **{f"frame_{count}_ms": value for count, value in ms.items()},
            **{f"ratio_{count}": ms[count] / ms["0"] for count in ("1", "4")},
        }


def _camera(photo: Camera, width: int, height: int) -> Camera:
    """A photo's pose with a view of this size that is as wide as the photo's."""
    focal = float(photo.intrinsics[0, 0]) * width / photo.width
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(photo.view_matrix, intrinsics.to(photo.view_matrix), width, height)


def _markdown(figures: dict[str, float], command: str, machine: str) -> str:
    f = figures
    rows = [
        ("decoding all Gaussians, once", f"{f['decode_ms']:.0f}", ""),
        ("a new text: encoded, scored on every Gaussian, checked for doubt", f"{f['text_ms']:.1f}", ""),
        ("a frame of colors alone", f"{f['frame_0_ms']:.0f}", "1"),
        ("… with one prompt", f"{f['frame_1_ms']:.0f}", f"{f['ratio_1']:.2f}"),
        ("… with four prompts", f"{f['frame_4_ms']:.0f}", f"{f['ratio_4']:.2f}"),
    ]
    return f"""# Queries

    {command}

{machine}. {f["gaussians"]:,.0f} Gaussians, {f["width"]:.0f}×{f["height"]:.0f}; medians.

{markdown_table(("", "ms", "ratio"), rows)}
"""
