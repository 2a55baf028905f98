"""`lang3dxl numerics`: error and run time of every component on hard cases, with pass or miss."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable, Iterable, Sequence
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
    "case",
    "mode",
    "output max / rms",
    "gradient max / rms",
    "flipped",
    "finite",
    "ms",
    "bound",
    "verdict",
)


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
    total = len(rows) + len(optimizations)
    passed = sum(not row.misses for row in rows) + sum(not run.misses for run in optimizations)
    components = list(dict.fromkeys(row.component for row in rows))
    tables = "\n\n".join(_section([row for row in rows if row.component == name]) for name in components)
    return f"""# Numerics: error against run time on stiff and extreme cases

`{command}`
{machine}.

**{passed} of {total} rows pass.** Every component runs on its hard cases. The same inputs, rounded as the
component sees them, go through a float64 reference written for clarity (rasterizer: every
Gaussian against every pixel; hash grid: corner by corner; downsampler: window by window; physical scale:
80 bits). Errors are relative to the reference's largest value (max) and root mean square (rms), the worst of
all outputs and of the gradients of all inputs for a random upstream gradient. Where the reference is not
finite (a NaN input's own row), the component may be anything; everywhere else "finite" means that output and
gradient are. flipped: share of pixels in which rounding moved a pair across the rasterizer's thresholds of
1/255 and 1e-4; these count in the output's error, not in the gradient's. bf16, fp16: mixed precision
(autocast). ms: one forward and backward. Bounds are in the order of the error columns.

{_summary(rows, components)}

![Error against time](numerics.png)

{tables}

{_optimization_section(optimizations)}
"""


def _summary(rows: list[Row], components: Iterable[str]) -> str:
    table = []
    for name in components:
        own = [row for row in rows if row.component == name]
        single = [row for row in own if row.mode in ("float32", "float64")]
        best = [row for row in single if row.mode == "float32"] or single
        slopes = [row.gradient_rms for row in best if row.gradient_rms is not None]
        table.append(
            [
                name,
                len(own),
                sum(not row.misses for row in own),
                _figure(_median(row.output_rms for row in best)),
                _figure(_median(slopes) if slopes else None),
                f"{_median(row.ms for row in best):.2g}",
            ]
        )
    header = ["component", "rows", "pass", "median output rms", "median gradient rms", "median ms"]
    return markdown_table(header, table)


def _median(values: Iterable[float]) -> float:
    finite = sorted(value for value in values if math.isfinite(value))
    return finite[len(finite) // 2] if finite else math.nan


def _section(rows: list[Row]) -> str:
    notes = dict.fromkeys(f"{row.case}: {row.note}." for row in rows if row.note)
    listed = "".join(f"\n- {note}" for note in notes)
    table = markdown_table(HEADER, [_cells(row) for row in rows])
    return f"## {rows[0].component[0].upper()}{rows[0].component[1:]}\n\n{table}" + (listed and f"\n{listed}")


def _optimization_section(optimizations: list[Run]) -> str:
    header = ["rates", "steps", "loss by fifths", "largest code by fifths", "finite", "s", "verdict"]
    table = [
        [
            run.name,
            f"{run.steps:,}",
            " ".join(f"{loss:.3g}" for loss in run.losses[1::2]),
            " ".join(f"{code:.3g}" for code in run.codes[1::2]),
            "yes" if run.finite else "**no**",
            f"{run.seconds:.0f}",
            "pass" if not run.misses else f"**miss**: {'; '.join(run.misses)}",
        ]
        for run in optimizations
    ]
    return f"""## Optimization of the field alone

Adam with epsilon 1e-15 at constant rates, on noisy targets. Parameters and moments must stay finite; at the
usual rates the loss must not rise again, and no code may pass 25 (at 17 the sigmoid's slope is 0 in float32).

{markdown_table(header, table)}"""


def _cells(row: Row) -> list[str | None]:
    b = row.bounds
    bound = f"{b.output_max:.0e} / {b.output_rms:.0e}"
    has_gradient = row.gradient_max is not None
    if has_gradient:
        bound += f" · {b.gradient_max:.0e} / {b.gradient_rms:.0e}"
    return [
        row.case,
        row.mode,
        f"{_figure(row.output_max)} / {_figure(row.output_rms)}",
        f"{_figure(row.gradient_max)} / {_figure(row.gradient_rms)}" if has_gradient else None,
        f"{row.flipped:.1%}" if row.flipped else None,
        "yes" if row.finite else "**no**",
        f"{row.ms:.2g}",
        bound,
        "pass" if not row.misses else f"**miss**: {'; '.join(row.misses)}",
    ]


def _figure(value: float | None) -> str:
    return "–" if value is None else "0" if value == 0 else f"{value:.0e}"


def _plot(rows: list[Row]) -> bytes:
    """PNG: error against time, for outputs and gradients; colors are components, markers are modes."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    components = list(dict.fromkeys(row.component for row in rows))
    palette = (
        "#0b2545",
        "#c0392b",
        "#2471a3",
        "#1e8449",
        "#b9770e",
        "#6c3483",
        "#7f8c8d",
        "#d98880",
        "#117864",
        "#f1c40f",
        "#ff6fb5",
        "#5dade2",
    )
    colors = {name: palette[i % len(palette)] for i, name in enumerate(components)}
    markers = {"float32": "o", "float64": "s", "bf16": "^", "fp16": "v", "tf32": "D"}
    smallest = 1e-18
    errors: dict[str, Callable[[Row], float | None]] = {
        "output": lambda row: row.output_rms,
        "gradient": lambda row: row.gradient_rms,
    }
    for panel, (title, error) in zip(panels, errors.items(), strict=True):
        for row in rows:
            value = error(row)
            if value is not None and math.isfinite(value):
                style = {"color": colors[row.component], "marker": markers[row.mode]}
                panel.plot(row.ms, max(value, smallest), markersize=4.5, alpha=0.7, linestyle="none", **style)
        panel.set(xscale="log", yscale="log", xlabel="forward + backward, ms", title=title)
        panel.grid(which="major", alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("relative RMS error (0 drawn at 1e-18)")
    used = [mode for mode in markers if any(row.mode == mode for row in rows)]
    keys = [Line2D([], [], color=colors[name], linewidth=3, label=name) for name in components]
    keys += [Line2D([], [], color="0.35", marker=markers[m], linestyle="none", label=m) for m in used]
    figure.legend(handles=keys, loc="outside lower center", ncols=6, frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=130)
    return file.getvalue()
