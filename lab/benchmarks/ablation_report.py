"""Tables of the ablation report."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from lab.benchmarks.ablation_rows import Row
from lab.benchmarks.scored_runs import Run
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report

FIGURES = {
    "test_map": ("mAP, test views", ".3f"),
    "map": ("mAP, held-out photos", ".3f"),
    "seen_map": ("mAP, seen photos", ".3f"),
    "test_raw_map": ("without blur, test views", ".3f"),
    "test_clip_l1": ("CLIP L1", ".3f"),
    "half_psnr": ("PSNR, half image", ".2f"),
    "test_cc_psnr": ("PSNR, matched", ".2f"),
    "train_seconds": ("train, s", ".0f"),
    "train_peak_mb": ("peak, MB", ".0f"),
    "render_ms": ("render, ms", ".0f"),
    "answer_ms": ("answer, ms", ".0f"),
}
Figures = Mapping[Run, Mapping[str, float]]


def write_ablation(
    folder: Path, command: str, rows: Sequence[Row], figures: Figures, failed: Mapping[Run, str]
) -> None:
    """Write ablation.md, .json and .csv from the results so far."""
    scenes = list(dict.fromkeys(run.label for run in (*figures, *failed)))
    lengths = sorted({run.steps for run in (*figures, *failed)})
    summary = {steps: [_summary(row, steps, scenes, figures, failed) for row in rows] for steps in lengths}
    quality = "test_map" if any("test_map" in found for found in figures.values()) else "map"
    mark_front([row for rows in summary.values() for row in rows], quality)
    data = {
        "command": command,
        "machine": describe_machine(),
        "scenes": scenes,
        "quality": quality,
        "lengths": summary,
    }
    write_report(folder, "ablation", markdown(data), data)
    write_atomically(folder / "ablation.csv", table_of_runs(figures))


def _summary(
    row: Row, steps: int, scenes: Sequence[str], figures: Figures, failed: Mapping[Run, str]
) -> dict[str, Any]:
    """Summarize a row's figures by scene and over all scenes, as mean and deviation over the seeds."""
    own = {run: found for run, found in figures.items() if run.row.name == row.name and run.steps == steps}
    names = list(dict.fromkeys(name for found in own.values() for name in found))
    by_scene = {
        scene: {
            name: spread([f[name] for run, f in own.items() if run.label == scene and name in f])
            for name in names
        }
        for scene in scenes
    }
    complete = {seed: [f for run, f in own.items() if run.seed == seed] for seed in {run.seed for run in own}}
    # The mean over scenes uses only seeds with all scenes; otherwise scenes would be mixed up with seeds.
    complete = {seed: found for seed, found in complete.items() if len(found) == len(scenes)}
    overall = {
        name: spread([mean(f[name] for f in found) for found in complete.values()])
        for name in names
        if all(name in f for found in complete.values() for f in found)
    }
    reasons = {reason for run, reason in failed.items() if (run.row.name, run.steps) == (row.name, steps)}
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
    """Compute mean, sample deviation (0 for a single value) and count; return None without values."""
    if not values:
        return None
    return {"mean": mean(values), "std": stdev(values) if len(values) > 1 else 0.0, "runs": len(values)}


def mark_front(rows: Sequence[dict[str, Any]], quality: str) -> None:
    """Add `front` to every row: whether no other is as fast and better, or as good and faster."""

    def point(row: Mapping[str, Any]) -> tuple[float, float]:
        return row["mean"]["train_seconds"]["mean"], -row["mean"][quality]["mean"]

    timed = [row for row in rows if {"train_seconds", quality} <= set(row["mean"])]
    for row in rows:
        row["front"] = row in timed and not any(
            point(o) != point(row) and all(a <= b for a, b in zip(point(o), point(row), strict=True))
            for o in timed
        )


def markdown(data: Mapping[str, Any]) -> str:
    """Format the report as markdown."""
    parts = []
    for steps, rows in data["lengths"].items():
        parts += [f"## {steps} iterations", _table(rows), *_means(rows, data["scenes"], data["quality"])]
    reasons = [(r["label"], why) for rows in data["lengths"].values() for r in rows for why in r["not_run"]]
    notes = "\n".join(f"- {label}: {why}" for label, why in dict.fromkeys(reasons))
    return f"""# Ablation

    {data["command"]}

{len(data["scenes"])} scene(s): {", ".join(data["scenes"])}. Mean ± deviation over the seeds.
{data["machine"]}

mAP: mean over the categories of the average precision of relevancy maps, at half the picture's size. Test
views are novel cameras with exact labels; "seen" are labeled training photos. CLIP L1 uses the same
downsampling kernel for all rows. Times are wall-clock with a GPU, processor time (all threads) without;
"train" excludes preparation of targets, "answer" is one view with all prompts. Bold: no other row
of any length is as fast and better. "Published" are Lang3D-XL's figures for HolyScenes: other photos,
another CLIP, other lengths.

{(chr(10) * 2).join(parts)}
""" + (f"\n## Not run here\n\n{notes}\n" if notes else "")


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    shown = [name for name in FIGURES if any(name in row["mean"] for row in rows)]
    published = any(row["published"] for row in rows)
    return markdown_table(
        ["", "row", *(FIGURES[name][0] for name in shown), *["published"] * published],
        [
            [row["group"], _bold(row), *_cells(row, shown), *[row["published"] or None] * published]
            for row in rows
        ],
    )


def _bold(row: Mapping[str, Any]) -> str:
    return f"**{row['label']}**" if row["front"] else row["label"]


def _cells(row: Mapping[str, Any], shown: Sequence[str]) -> list[str | None]:
    if not row["mean"] and row["not_run"]:
        return ["not run here", *[None] * (len(shown) - 1)]
    return [_cell(row["mean"].get(name), FIGURES[name][1]) for name in shown]


def _cell(value: Mapping[str, float] | None, form: str) -> str | None:
    if value is None:
        return None
    deviation = f" ± {value['std']:{form}}" if value["runs"] > 1 else ""
    return f"{value['mean']:{form}}{deviation}"


def _means(rows: Sequence[Mapping[str, Any]], scenes: Sequence[str], quality: str) -> Iterator[str]:
    """Yield tables of precision by scene, by family (cathedral-700, -701 …) if one has several scenes, with
    the deviation between them, and by category, over the scenes that have it."""
    yield _mean_table("mAP", rows, {scene: [(scene, quality)] for scene in scenes})
    families: dict[str, list[tuple[str, str]]] = {}
    for scene in scenes:
        families.setdefault(scene.rpartition("-")[0] or "other", []).append((scene, quality))
    if max(map(len, families.values())) > 1:
        yield _mean_table("mAP by family", rows, families)
    start = quality.removesuffix("map") + "ap_"
    found = [name for row in rows for figures in row["scenes"].values() for name in figures]
    names = [n for n in dict.fromkeys(found) if n.startswith(start) and not n.endswith("_photos")]
    categories = {name.removeprefix(start): [(scene, name) for scene in scenes] for name in names}
    yield _mean_table("AP", rows, categories)


def _mean_table(
    title: str, rows: Sequence[Mapping[str, Any]], columns: Mapping[str, Sequence[tuple[str, str]]]
) -> str:
    """Format a table with a line per row: the mean ± deviation of each column's scenes, or of one's seeds."""
    lines = []
    for row in rows:
        cells = []
        for wanted in columns.values():
            found = [row["scenes"][scene][name] for scene, name in wanted if name in row["scenes"][scene]]
            value = found[0] if len(wanted) == 1 and found else spread([one["mean"] for one in found])
            cells.append(_cell(value, ".3f"))
        lines.append([row["label"], *cells])
    return markdown_table([title, *columns], lines)


def table_of_runs(figures: Figures) -> str:
    """Format all figures as CSV, with a line per run."""
    names = list(dict.fromkeys(name for found in figures.values() for name in found))
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["row", "group", "scene", "steps", "seed", *names])
    for run, found in figures.items():
        values = [found.get(name, "") for name in names]
        writer.writerow([run.row.name, run.row.group, run.label, run.steps, run.seed, *values])
    return file.getvalue()
