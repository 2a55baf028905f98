"""`lang3dxl numerics`: error and run time of components on hard cases, with a verdict for each."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import torch

from lab.numerics import optimization
from lab.numerics.catalog import all_cases
from lab.numerics.measure import Case, Row, measure
from lab.reports import command_line
from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.common.device import best_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.common.reports import describe_machine, markdown_table

HEADER = "component", "case", "mode", "output", "gradient", "bounds", "flipped", "ms", "verdict"
SMALLEST = 1e-18
"""Smallest error in the plot; lower ones are drawn here."""


@dataclass(kw_only=True)
class Numerics:
    """Measure error and time on stiff and extreme cases of rendering, training and queries.

    Exits 1 if a case misses its bound.
    """

    out: Path
    """Folder in which numerics.md and numerics.png are written."""
    quick: bool = False
    """Run smaller cases and skip float64: about a minute, for continuous integration."""
    device: str = "auto"
    """Device to measure on: auto (a GPU if there is one), cpu or cuda."""

    def main(self) -> None:
        """Measure, write the report, and exit with an error if a case missed its bound."""
        if find_spec("matplotlib") is None:
            raise UserError("numerics.png needs matplotlib: pip install -e '.[lab]' in the checkout")
        device = best_device() if self.device == "auto" else self.device
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # the timer measures processor time
        try:
            repeats = 1 if self.quick else 3
            rows = measure_all(list(all_cases(self.quick, device)), self.quick, device, repeats)
            runs = optimization.runs(self.quick)
            heading = f"`{command_line('lang3dxl numerics', self)}`\n{describe_machine(device)}."
        finally:
            torch.set_num_threads(threads)
        judged: list[Row | optimization.Run] = [*rows, *runs]
        misses = [f"{row.name}: {'; '.join(row.misses)}" for row in judged if row.misses]
        verdict = f"{len(judged) - len(misses)} of {len(judged)} rows pass"
        write_atomically(self.out / "numerics.md", _markdown(rows, runs, heading, verdict))
        write_atomically(self.out / "numerics.png", _plot(rows))
        for miss in misses:
            print(f"MISS {miss}")
        print(f"{verdict}; report: {self.out}")
        if misses:
            sys.exit(1)


def measure_all(cases: Sequence[Case], quick: bool, device: str, repeats: int = 0) -> list[Row]:
    """Measure every case in every mode; `quick` skips float64 where there is another mode. repeats: number of
    timed repetitions, as in `measure`."""
    pairs = [
        (case, mode)
        for case in cases
        for mode in case.bounds
        if not (quick and mode == "float64" and len(case.bounds) > 1)
    ]
    return [measure(case, mode, device, repeats) for case, mode in tracked(pairs, "numerics")]


def _markdown(rows: Sequence[Row], runs: Sequence[optimization.Run], heading: str, verdict: str) -> str:
    notes = dict.fromkeys(f"- {row.component}, {row.case}: {row.note}" for row in rows if row.note)
    table = markdown_table(HEADER, [*map(_cells, rows), *map(_optimization, runs)])
    return f"""# Numerics: error against run time on stiff and extreme cases

{heading}

**{verdict}.** Components run on their hard cases, and the same inputs, rounded as the component sees
them, go through a float64 reference written for clarity. Errors of outputs and gradients (for a random
upstream gradient) are the largest and the root mean square, relative to the reference's, the worst of all
tensors; so are their bounds. Where the reference is not finite, the component may be anything. flipped: share
of pixels in which rounding moved a pair across the rasterizer's thresholds; they don't count in the
gradient's error. bf16, fp16: mixed precision. ms: one forward and backward. An optimization must stay finite,
and its loss must not rise again.

![Error against time](numerics.png)

{table}

{chr(10).join(notes)}
"""


def _cells(row: Row) -> list[str | None]:
    b = row.bounds
    slopes, bounds = None, f"{b.output_max:.0e} / {b.output_rms:.0e}"
    if row.gradient_max is not None:
        slopes = f"{row.gradient_max:.0e} / {row.gradient_rms:.0e}"
        bounds += f" · {b.gradient_max:.0e} / {b.gradient_rms:.0e}"
    output, shares = f"{row.output_max:.0e} / {row.output_rms:.0e}", [f"{row.flipped:.1%}", f"{row.ms:.2g}"]
    return [row.component, row.case, row.mode, output, slopes, bounds, *shares, _verdict(row)]


def _optimization(run: optimization.Run) -> list[str | None]:
    case, ms = f"{run.case}, {run.steps:,} steps", f"{1e3 * run.seconds:.0f}"
    return ["optimization", case, "float32", *[None] * 4, ms, _verdict(run)]


def _verdict(row: Row | optimization.Run) -> str:
    return f"**miss**: {'; '.join(row.misses)}" if row.misses else "pass"


def _plot(rows: Sequence[Row]) -> bytes:
    """Plot error against time as a PNG, for outputs and gradients, with a color per component."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for number, component in enumerate(dict.fromkeys(row.component for row in rows)):
        own = [row for row in rows if row.component == component]
        style = {"s": 14, "color": colormaps["tab20"](number), "label": component}
        panels[0].scatter([row.ms for row in own], [max(row.output_rms, SMALLEST) for row in own], **style)
        slopes = [(row.ms, max(row.gradient_rms, SMALLEST)) for row in own if row.gradient_rms is not None]
        panels[1].scatter([ms for ms, _ in slopes], [error for _, error in slopes], **style)
    for panel, title in zip(panels, ("output", "gradient"), strict=True):
        panel.set(xscale="log", yscale="log", xlabel="forward + backward, ms", title=title)
        panel.grid(alpha=0.25)
    panels[0].set_ylabel(f"relative RMS error (0 drawn at {SMALLEST:.0e})")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()
