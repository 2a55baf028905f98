"""`lang3dxl benchmark error-vs-time`: what every knob that trades quality for time gives and takes."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from lang3dxl_ns.baselines.rows import OF_TARGETS, ROWS, Row
from lang3dxl_ns.benchmarks.ablation import ComparisonSettings, make_all
from lang3dxl_ns.benchmarks.ablation_report import Figures, spread
from lang3dxl_ns.benchmarks.scored_runs import Run, ScoredRuns, scene_labels
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.report import (
    command_line,
    describe_machine,
    markdown_table,
    write_atomically,
    write_report,
)

DEFAULT = ROWS[0]
"""The method as it is: the same runs as in the ablation, which the two share in one folder."""
STAGES = {"prepare": "setup_seconds", "train": "train_seconds", "query": "query_seconds"}
"""The time that a stage's knobs are held against."""
QUALITIES = {
    "map": ("mAP", 1),
    "seen_map": ("mAP, seen photos", 1),
    "clip_l1": ("CLIP L1", -1),
    "psnr": ("PSNR, dB", 1),
}
"""Name, and 1 where more is better."""

_MODEL, _DATA = "pipeline.model.", "pipeline.datamanager."
_KNOBS: dict[str, tuple[str, Sequence[Any]]] = {
    "densify above": (f"{_MODEL}densify_grad_thresh", (5e-4, 1e-3, 1.0)),
    "hash levels": (f"{_MODEL}semantic_field.levels", (4, 12)),
    "hash features": (f"{_MODEL}semantic_field.features_per_level", (2, 8)),
    "log2 hash table": (f"{_MODEL}semantic_field.log2_table_size", (9, 15)),
    "decoder width": (f"{_MODEL}semantic_field.hidden_width", (32, 128)),
    "decode size": (f"{_MODEL}decode_size", ((32, 40), (80, 120))),
    "downsampler width": (f"{_MODEL}downsampler.hidden", (0, 64)),
    "16-bit": ("mixed_precision", (True,)),
    "dense tokens": (f"{_DATA}dense_tokens", (24, 64)),
    "crop sizes": (f"{_DATA}scales", (1, 3)),
}
_STEPS = (1 / 8, 1 / 4, 1 / 2, 2)
"""Multiples of the run's length."""
_SIZES = (1 / 2, 0.7, 1.5)
"""Multiples of the photos' size in training."""


@dataclass
class ErrorVsTime(ComparisonSettings):
    """Turn one knob at a time on one scene, and hold average precision, feature error and PSNR against the
    time of the stage that the knob belongs to; the settings that nothing else beats in both are marked.

    A finished run is not made again, as in `lang3dxl benchmark ablation`. The lookup table's size has a
    benchmark of its own: `lang3dxl benchmark lookup`.
    """

    quick: bool = False
    """A quarter of an hour instead of hours: 150 iterations, one seed, the extremes of every knob."""

    def main(self) -> None:
        if self.quick:
            self.steps, self.seeds = min(self.steps, 150), 1
        scenes = scene_labels(self.scene)
        if len(scenes) != 1:
            raise UserError(f"one scene is swept at a time, not {len(scenes)}: give one --scene")
        ((label, path),) = scenes.items()
        runs = [Run(row, path, label, seed) for seed in range(self.seeds) for row in self.rows()]
        store = ScoredRuns(self.out, self.run_settings())
        figures, failed = make_all(runs, store, self._write, self.workers)
        print(f"Wrote {self.out / 'error_vs_time.md'} ({len(figures)} runs, {len(failed)} not run)")

    def rows(self) -> list[Row]:
        """The default, the other settings of every knob, and the encoders to compare with."""
        rows = [DEFAULT]
        made_anew = {f"{_DATA}dense_tokens": self.dense_tokens}  # as it is, but with targets of its own
        rows.append(Row("targets", "prepare", "as it is", made_anew))
        for steps in (max(round(self.steps * multiple), 1) for multiple in self._some(_STEPS)):
            rows.append(Row(f"steps-{steps}", "train", f"{steps} iterations", {"max_num_iterations": steps}))
        sizes = [round(self.scale * multiple, 4) for multiple in _SIZES]
        knobs = {"photo size": (f"{_DATA}camera_res_scale_factor", sizes), **_KNOBS}
        if not torch.cuda.is_available():
            del knobs["16-bit"]  # nerfstudio has it on GPUs alone
        for knob, (path, values) in knobs.items():
            stage = "prepare" if path.removeprefix(_DATA) in OF_TARGETS else "train"
            for value in self._some(values):
                text = "–".join(map(str, value)) if isinstance(value, tuple) else str(value)
                rows.append(Row(f"{knob}-{text}".replace(" ", "-"), stage, f"{knob} {text}", {path: value}))
        return rows + [
            Row(row.name, "query", row.label, row.changes) for row in ROWS if row.group == "encoder"
        ]

    def _some(self, values: Sequence[Any]) -> Sequence[Any]:
        """The extremes, with `quick`."""
        return (values[0], values[-1]) if self.quick and len(values) > 1 else values

    def _write(self, figures: Figures, failed: Mapping[Run, str]) -> None:
        points = stage_points(self.rows(), figures)
        data = {
            "command": command_line("lang3dxl benchmark error-vs-time", self),
            "machine": describe_machine("cuda" if torch.cuda.is_available() else "cpu"),
            "points": points,
            "failed": {run.name: reason for run, reason in failed.items()},
        }
        write_report(self.out, "error_vs_time", markdown(data), data)
        if points:
            write_atomically(self.out / "error_vs_time.png", plot(points))


def stage_points(rows: Sequence[Row], figures: Figures) -> list[dict[str, Any]]:
    """Every row's seconds and qualities, means over the seeds; training and query hold all rows that have
    them, preparation those that made their targets anew."""
    points = []
    for row in rows:
        found = [_with_query(f) for run, f in figures.items() if run.row.name == row.name]
        for stage, clock in STAGES.items():
            measured = [f for f in found if clock in f]
            if not measured or (stage == "prepare" and not row.own_targets):
                continue
            names = (clock, *QUALITIES)
            spreads = {name: spread([f[name] for f in measured if name in f]) for name in names}
            values = {name: value for name, value in spreads.items() if value}
            points.append(
                {"row": row.name, "label": row.label, "stage": stage, "seconds": values.pop(clock), **values}
            )
    for stage in STAGES:
        mark_front([point for point in points if point["stage"] == stage])
    return points


def _with_query(figures: Mapping[str, float]) -> dict[str, float]:
    """With the seconds from a camera to all prompts' maps."""
    if "answer_ms" not in figures:
        return dict(figures)
    return {**figures, "query_seconds": (figures["render_ms"] + figures["answer_ms"]) / 1000}


def mark_front(points: Sequence[dict[str, Any]]) -> None:
    """Add to every point `front`: the qualities in which no other point is as fast and better, or as good and
    faster."""
    for point in points:
        point["front"] = []
        for name, (_, sign) in QUALITIES.items():
            if name not in point:
                continue
            mine = (point["seconds"]["mean"], -sign * point[name]["mean"])
            others = [(p["seconds"]["mean"], -sign * p[name]["mean"]) for p in points if name in p]
            if not any(o != mine and o[0] <= mine[0] and o[1] <= mine[1] for o in others):
                point["front"].append(name)


def markdown(data: Mapping[str, Any]) -> str:
    """The report for people; figures on the Pareto front are bold."""
    tables = []
    for stage in STAGES:
        points = [point for point in data["points"] if point["stage"] == stage]
        if not points:
            continue
        rows = [
            [p["label"], _cell(p["seconds"], ".3g"), *(_quality(p, name) for name in QUALITIES)]
            for p in sorted(points, key=lambda p: p["seconds"]["mean"])
        ]
        header = ["", f"{stage}, s", *(label for label, _ in QUALITIES.values())]
        tables.append(f"## {stage.capitalize()}\n\n{markdown_table(header, rows)}")
    failed = "".join(f"\n- not run: {name}: {reason}" for name, reason in data["failed"].items())
    return f"""# Error against run time

    {data["command"]}

{data["machine"]}. One knob is turned at a time; mean ± deviation over the seeds. Bold: on the Pareto front of
its stage, where nothing else is both faster and better. Seconds are of the clock with a GPU, of the processor
(all threads) without one. The size of the lookup table is swept by `lang3dxl benchmark lookup`.

{chr(10).join(f"{table}{chr(10)}" for table in tables)}
![Error against run time](error_vs_time.png)
{failed}"""


def _quality(point: Mapping[str, Any], name: str) -> str | None:
    if name not in point:
        return None
    text = _cell(point[name], ".3f")
    return f"**{text}**" if name in point["front"] else text


def _cell(value: Mapping[str, float], form: str) -> str:
    deviation = f" ± {value['std']:.2g}" if value["runs"] > 1 else ""
    return f"{value['mean']:{form}}{deviation}"


def plot(points: Sequence[Mapping[str, Any]]) -> bytes:
    """PNG: a row of axes per stage, the three qualities over the logarithm of time; the front as a line."""
    from matplotlib.figure import Figure

    stages = [stage for stage in STAGES if any(point["stage"] == stage for point in points)]
    figure = Figure(figsize=(4 * len(QUALITIES), 3.2 * len(stages)), layout="constrained")
    grid = figure.subplots(len(stages), len(QUALITIES), squeeze=False)
    for line, stage in zip(grid, stages, strict=True):
        for axes, (name, (quality, _)) in zip(line, QUALITIES.items(), strict=True):
            shown = [point for point in points if point["stage"] == stage and name in point]
            axes.set(xscale="log", xlabel=f"{stage}, s", ylabel=quality)
            axes.spines[["top", "right"]].set_visible(False)
            for point in shown:
                place = (point["seconds"]["mean"], point[name]["mean"])
                default, on_front = point["row"] == DEFAULT.name, name in point["front"]
                colour = "C3" if default else "C0" if on_front else "0.7"
                axes.plot(*place, "*" if default else "o", color=colour, markersize=10 if default else 4)
                if default or on_front:  # all names would hide each other
                    label = point["label"].split(":")[0]
                    axes.annotate(label, place, (3, 3), textcoords="offset points", fontsize=6)
            front = sorted((p["seconds"]["mean"], p[name]["mean"]) for p in shown if name in p["front"])
            if front:
                axes.plot(*zip(*front, strict=True), color="0.6", linewidth=1, zorder=0)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()
