"""`lang3dxl numerics`: error and run time of every component on hard cases, with pass or miss."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from lang3dxl_ns.common.device import best_device
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.common.reports import (
    command_line,
    describe_machine,
    markdown_table,
    progress_bar,
    write_report,
)
from lang3dxl_ns.numerics.catalog import all_cases
from lang3dxl_ns.numerics.measure import Case, Row, measure
from lang3dxl_ns.numerics.optimization import Run, runs

HEADER = (
    "case", "mode", "output max / rms", "gradient max / rms", "flipped", "finite", "ms", "bound", "verdict"
)  # fmt: skip
OPTIMIZATION_HEADER = (
    "rates", "steps", "loss by fifths", "largest code by fifths", "finite", "s", "verdict"
)  # fmt: skip
SMALLEST = 1e-18
"""Errors below are drawn here."""


@dataclass(kw_only=True)
class Numerics:
    """Measure the error and time of every component on stiff and extreme cases; exit 1 on any miss."""

    out: Path
    """Folder for numerics.md, numerics.json and numerics.png."""
    quick: bool = False
    """Smaller cases in single precision only, about a minute: for continuous integration."""
    device: str = "auto"
    """Device: auto (a GPU if there is one), cpu, cuda."""

    def main(self) -> None:
        """Measure, write the report, and exit with an error if a case missed its bound."""
        device = self.device
        if device == "auto":
            device = best_device()
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # the timer measures processor time
        try:
            rows = measure_all(list(all_cases(self.quick, device)), self.quick, device)
            optimizations = runs(self.quick)
            machine = describe_machine(device)
        finally:
            torch.set_num_threads(threads)
        lines = [
            f"{row.component}, {row.case}, {row.mode}: {'; '.join(row.misses)}" for row in rows if row.misses
        ]
        lines += [f"optimization, {run.name}: {'; '.join(run.misses)}" for run in optimizations if run.misses]
        command = command_line("lang3dxl numerics", self)
        data = {"command": command, "machine": machine, "rows": [_plain(row) for row in rows]}
        data["optimizations"] = [_plain(run) for run in optimizations]
        write_report(self.out, "numerics", _markdown(rows, optimizations, command, machine), data)
        write_atomically(self.out / "numerics.png", _plot(rows))
        for line in lines:
            print(f"MISS {line}")
        total = len(rows) + len(optimizations)
        print(f"{total - len(lines)} of {total} rows pass; report: {self.out}")
        if lines:
            sys.exit(1)


def measure_all(cases: Sequence[Case], quick: bool, device: str) -> list[Row]:
    """A row for every case and mode; `quick` skips float64 where there is another mode."""
    pairs = [
        (case, mode)
        for case in cases
        for mode in case.bounds
        if not (quick and mode == "float64" and len(case.bounds) > 1)
    ]
    rows = []
    with progress_bar() as bar:
        task = bar.add_task("numerics", total=len(pairs))
        for case, mode in pairs:
            rows.append(measure(case, mode, device, repeats=1 if quick else 3))
            bar.advance(task)
    return rows


def _plain(row: Row | Run) -> dict[str, Any]:
    """JSON has no NaN: NaN and infinity become null."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: plain(inner) for name, inner in value.items()}
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return plain(asdict(row)) | {"misses": row.misses}


def _markdown(rows: list[Row], optimizations: list[Run], command: str, machine: str) -> str:
    passed = sum(not row.misses for row in rows) + sum(not run.misses for run in optimizations)
    components = dict.fromkeys(row.component for row in rows)
    tables = "\n\n".join(_section([row for row in rows if row.component == name]) for name in components)
    return f"""# Numerics: error against run time on stiff and extreme cases

`{command}`
{machine}.

**{passed} of {len(rows) + len(optimizations)} rows pass.** Every component runs on its hard cases. The same
inputs, rounded as the component sees them, go through a float64 reference written for clarity. Errors are
relative to the reference's largest value (max) and root mean square (rms), the worst of all outputs and of
the gradients of all inputs for a random upstream gradient. Where the reference is not finite (a NaN input's
own row), the component may be anything; everywhere else "finite" means that output and gradient are.
flipped: share of pixels in which rounding moved a pair across the rasterizer's thresholds of 1/255 and 1e-4;
these count in the output's error, not in the gradient's. bf16, fp16: mixed precision (autocast). ms: one
forward and backward. Bounds are in the order of the error columns.

![Error against time](numerics.png)

{tables}

## Optimization of the field alone

Adam with epsilon 1e-15 at constant rates, on noisy targets. Parameters and moments must stay finite; at the
usual rates the loss must not rise again, and no code may pass 25 (at 17 the sigmoid's slope is 0 in float32).

{markdown_table(OPTIMIZATION_HEADER, map(_optimization, optimizations))}
"""


def _section(rows: list[Row]) -> str:
    notes = dict.fromkeys(f"\n- {row.case}: {row.note}." for row in rows if row.note)
    name = rows[0].component
    table = markdown_table(HEADER, map(_cells, rows))
    return f"## {name[0].upper()}{name[1:]}\n\n{table}\n" + "".join(notes)


def _cells(row: Row) -> list[str | None]:
    b = row.bounds
    bound, slopes = f"{b.output_max:.0e} / {b.output_rms:.0e}", None
    if row.gradient_max is not None:
        bound += f" · {b.gradient_max:.0e} / {b.gradient_rms:.0e}"
        slopes = f"{row.gradient_max:.0e} / {row.gradient_rms:.0e}"
    return [
        row.case, row.mode, f"{row.output_max:.0e} / {row.output_rms:.0e}", slopes,
        f"{row.flipped:.1%}" if row.flipped else None, "yes" if row.finite else "**no**", f"{row.ms:.2g}",
        bound, _verdict(row),
    ]  # fmt: skip


def _optimization(run: Run) -> list[str]:
    fifths = (" ".join(f"{value:.3g}" for value in values[1::2]) for values in (run.losses, run.codes))
    finite = "yes" if run.finite else "**no**"
    return [run.name, f"{run.steps:,}", *fifths, finite, f"{run.seconds:.0f}", _verdict(run)]


def _verdict(row: Row | Run) -> str:
    return f"**miss**: {'; '.join(row.misses)}" if row.misses else "pass"


def _plot(rows: list[Row]) -> bytes:
    """PNG: error against time, for outputs and gradients; a color per component."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    components = list(dict.fromkeys(row.component for row in rows))
    for panel, title in zip(panels, ("output", "gradient"), strict=True):
        for number, component in enumerate(components):
            own = [(r.ms, getattr(r, f"{title}_rms")) for r in rows if r.component == component]
            drawn = [(ms, max(error, SMALLEST)) for ms, error in own if error is not None]
            panel.scatter(
                *zip(*drawn, strict=True) if drawn else ((), ()),
                s=14,
                color=colormaps["tab20"](number),
                label=component,
            )
        panel.set(xscale="log", yscale="log", xlabel="forward + backward, ms", title=title)
        panel.grid(alpha=0.25)
    panels[0].set_ylabel(f"relative RMS error (0 drawn at {SMALLEST:.0e})")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=130)
    return file.getvalue()
