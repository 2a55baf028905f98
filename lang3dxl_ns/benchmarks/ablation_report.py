"""The tables and the plot of a comparison of runs."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from lang3dxl_ns.baselines.rows import FULL, TEACHER, Row
from lang3dxl_ns.benchmarks.scored_runs import Run
from lang3dxl_ns.evaluation.report import describe_machine, markdown_table, write_atomically, write_report

FIGURES = {
    "map": ("mAP", ".3f"),
    "seen_map": ("mAP, seen photos", ".3f"),
    "raw_map": ("mAP without blur", ".3f"),
    "localisation_accuracy": ("located", ".3f"),
    "clip_l1": ("CLIP L1", ".3f"),
    "clip_psnr": ("CLIP PSNR", ".2f"),
    "clip_cosine": ("CLIP cosine", ".3f"),
    "psnr": ("PSNR", ".2f"),
    "train_seconds": ("train, s", ".0f"),
    "train_peak_mb": ("peak, MB", ".0f"),
    "render_ms": ("render, ms", ".0f"),
    "answer_ms": ("answer, ms", ".0f"),
}
Figures = Mapping[Run, Mapping[str, float]]


def write_ablation(
    folder: Path,
    command: str,
    rows: Sequence[Row],
    scenes: Sequence[str],
    figures: Figures,
    failed: Mapping[Run, str],
) -> None:
    """Write ablation.md, .json, .csv and .png from what there is so far."""
    summary = [_summary(row, scenes, figures, failed) for row in rows]
    data = {"command": command, "machine": describe_machine(), "scenes": list(scenes), "rows": summary}
    write_report(folder, "ablation", markdown(data), data)
    write_atomically(folder / "ablation.csv", table_of_runs(figures))
    if any("map" in row["mean"] for row in summary):
        write_atomically(folder / "ablation.png", plot(summary))


def _summary(row: Row, scenes: Sequence[str], figures: Figures, failed: Mapping[Run, str]) -> dict[str, Any]:
    """A row's figures by scene and over all scenes, each a mean and a deviation over the seeds."""
    own = {run: found for run, found in figures.items() if run.row.name == row.name}
    names = list(dict.fromkeys(name for found in own.values() for name in found))
    by_scene = {
        scene: {
            name: spread([f[name] for run, f in own.items() if run.label == scene and name in f])
            for name in names
        }
        for scene in scenes
    }
    complete = {seed: [f for run, f in own.items() if run.seed == seed] for seed in {run.seed for run in own}}
    # A mean over scenes counts where the seed has all of them: else scenes would pass for seeds.
    complete = {seed: found for seed, found in complete.items() if len(found) == len(scenes)}
    overall = {
        name: spread([mean(f[name] for f in found) for found in complete.values()])
        for name in names
        if all(name in f for found in complete.values() for f in found)
    }
    reasons = {reason for run, reason in failed.items() if run.row.name == row.name}
    return {
        "row": row.name,
        "group": row.group,
        "label": row.label,
        "published": row.published,
        "changes": dict(row.changes),
        "scenes": {s: {n: v for n, v in found.items() if v} for s, found in by_scene.items()},
        "mean": {name: value for name, value in overall.items() if value},
        "not_run": sorted(reasons),
    }


def spread(values: Sequence[float]) -> dict[str, float] | None:
    """Mean, deviation (of the sample; 0 of a single value) and number; None of nothing."""
    if not values:
        return None
    return {"mean": mean(values), "std": stdev(values) if len(values) > 1 else 0.0, "runs": len(values)}


def markdown(data: Mapping[str, Any]) -> str:
    """The report for people."""
    scenes = data["scenes"]
    notes = [f"- {row['label']}: {'; '.join(row['not_run'])}" for row in data["rows"] if row["not_run"]]
    table = markdown_table(
        ["", "row", *(label for label, _ in FIGURES.values()), "published, another dataset"],
        [
            [row["group"], row["label"], *_cells(row["mean"], row["not_run"]), row["published"] or None]
            for row in data["rows"]
        ],
    )
    return f"""# Ablation

    {data["command"]}

Held-out photos of {len(scenes)} scene(s): {", ".join(scenes)}; "seen": the photos that training saw. Mean ±
deviation over the seeds.
{data["machine"]}

{table}

mAP: mean over the categories of the average precision of relevancy maps, blurred by 2.5 pixels at half the
photo's size. "located": how often the highest pixel lies on the object. Times are of the clock with a GPU, of
the processor (all threads) without one. "train" has no preparation of targets in it; "answer" decodes a
rendered view and compares it with all prompts, without a lookup table. The last column is what Lang3D-XL
prints for HolyScenes: other photos, another CLIP, other lengths of training. Compare its order with this one,
not its figures.

## mAP by scene

{_scene_table(data)}

## AP by category

{_category_table(data)}

![mAP](ablation.png)
""" + ("\n## Not run here\n\n" + "\n".join(notes) + "\n" if notes else "")


def _cells(found: Mapping[str, Any], not_run: Sequence[str]) -> list[str | None]:
    if not found and not_run:
        return ["not run here", *[None] * (len(FIGURES) - 1)]
    return [_cell(found.get(name), form) for name, (_, form) in FIGURES.items()]


def _cell(value: Mapping[str, float] | None, form: str) -> str | None:
    if value is None:
        return None
    deviation = f" ± {value['std']:{form}}" if value["runs"] > 1 else ""
    return f"{value['mean']:{form}}{deviation}"


def _scene_table(data: Mapping[str, Any]) -> str:
    return markdown_table(
        ["row", *data["scenes"]],
        [
            [row["label"], *(_cell(row["scenes"][scene].get("map"), ".3f") for scene in data["scenes"])]
            for row in data["rows"]
        ],
    )


def _category_table(data: Mapping[str, Any]) -> str:
    """Means over the scenes that have the category."""

    def is_category(name: str) -> bool:
        return name.startswith("ap_") and not name.endswith("_photos")

    found = [row["scenes"][scene] for row in data["rows"] for scene in data["scenes"]]
    names = list(dict.fromkeys(name for figures in found for name in figures if is_category(name)))

    def over_scenes(row: Mapping[str, Any], name: str) -> str | None:
        values = [figures[name]["mean"] for figures in row["scenes"].values() if name in figures]
        return f"{mean(values):.3f}" if values else None

    return markdown_table(
        ["row", *(name.removeprefix("ap_") for name in names)],
        [[row["label"], *(over_scenes(row, name) for name in names)] for row in data["rows"]],
    )


def table_of_runs(figures: Figures) -> str:
    """CSV with a line per run."""
    names = list(dict.fromkeys(name for found in figures.values() for name in found))
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["row", "group", "scene", "seed", *names])
    for run, found in figures.items():
        values = [found.get(name, "") for name in names]
        writer.writerow([run.row.name, run.row.group, run.label, run.seed, *values])
    return file.getvalue()


def plot(summary: Sequence[Mapping[str, Any]]) -> bytes:
    """PNG: mAP of every row, bars for held-out photos and dots for those seen in training, the full method's
    as a line."""
    from matplotlib.figure import Figure

    rows = [row for row in summary if "map" in row["mean"]]
    groups = list(dict.fromkeys(row["group"] for row in rows))
    figure = Figure(figsize=(7, 1.2 + 0.3 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for index, row in enumerate(rows):
        value = row["mean"]["map"]
        axes.barh(index, value["mean"], xerr=value["std"], color=f"C{groups.index(row['group'])}", height=0.7)
        axes.text(0.005, index, row["label"], va="center", color="white", fontsize=8)
        if seen := row["mean"].get("seen_map"):
            axes.plot(seen["mean"], index, "o", color="0.3", markersize=4)
        if row["row"] in (FULL, TEACHER):
            axes.axvline(
                value["mean"], color="0.3", linewidth=1, linestyle="-" if row["row"] == FULL else ":"
            )
    axes.set(
        yticks=[],
        xlabel="mAP held out (lines: the method, dotted its 2-D teacher); dots: in photos seen in training",
    )
    axes.invert_yaxis()
    axes.spines[["top", "right", "left"]].set_visible(False)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()
