"""What the lookup table costs and how wrong it is, beside the exact path in the same run."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.evaluation.aggregate import mean_average_precision
from lang3dxl_ns.evaluation.average_precision import mean_over_photos
from lang3dxl_ns.evaluation.ground_truth import GroundTruth, find_ground_truth, scoring_size
from lang3dxl_ns.evaluation.report import (
    command_line,
    describe_machine,
    interleaved_times,
    markdown_table,
    progress_bar,
    write_report,
)
from lang3dxl_ns.evaluation.scores import resize_map, score_maps
from lang3dxl_ns.files import write_atomically
from lang3dxl_ns.query.lookup import CodeScorer, CodeTable, mark_cells, table_error, tabulate
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.scene import PROBES, Scene, View
from lang3dxl_ns.query.scene_file import ScenePhoto
from lang3dxl_ns.rendering import Camera

EXACT = "exact"
_PIXELS_PER_PHOTO = 50_000


@dataclass
class LookupBenchmark:
    """Error of the lookup table against its size and time, on held-out photos, beside the exact path.

    Prompts are the categories of the ground truth, where the scene has one, else everyday words.
    """

    load_config: Path
    """config.yml of the run."""
    out: Path
    """Folder for lookup.md, lookup.json and lookup.png."""
    sizes: tuple[int, ...] = (16, 32, 64, 128)
    """Cells per axis."""
    frame: tuple[int, int] = (640, 480)
    """Width and height of the frame that is timed."""
    photos: int = 20
    """Held-out photos to compare on, at most."""
    repeats: int = 5
    """Timed runs of each candidate; their median counts."""
    ground_truth: Path | None = None
    """Folder of ground truth (default: what lies with the run's data)."""

    def main(self) -> None:
        from lang3dxl_ns.scene_loading import load_scene

        results = measure(load_scene(self.load_config), self)
        write_atomically(self.out / "lookup.png", plot(results))
        write_report(self.out, "lookup", markdown(self, results), results)
        print(f"Wrote {self.out / 'lookup.md'}")


@dataclass
class _Comparison:
    """What is gathered of a candidate, photo by photo."""

    scorer: CodeScorer
    sampled: list[Float[Tensor, "q n"]] = field(default_factory=list)
    scores: list[dict[str, float]] = field(default_factory=list)
    decoded: list[float] = field(default_factory=list)
    """Share of each photo's pixels that the table doesn't know."""


def measure(scene: Scene, settings: LookupBenchmark) -> dict[str, Any]:
    """All figures: of the exact path, and of a table of each size."""
    truth = _ground_truth(scene, settings)
    prompts = truth.categories if truth else list(PROBES)
    queries = scene.text.plain_queries(prompts).to(scene.device)
    codes, probes = scene.rendered_codes(), scene.text.plain_queries(PROBES).to(scene.device)
    clock = (
        time.process_time
        if scene.device.type == "cpu" and torch.get_num_threads() == 1
        else time.perf_counter
    )
    wall = clock is time.perf_counter
    tables: dict[str, CodeTable] = {}
    built: dict[str, float] = {}
    for size in settings.sizes:
        start = clock()
        table = tabulate(scene.decode, mark_cells(codes, size, scene.bounded))
        table.leave_out_rough_cells(scene.decode, probes, scene.config.lookup.tolerance)
        tables[str(size)] = table
        built[str(size)] = clock() - start
    exact = scene.scorer(exact=True)
    scorers = {EXACT: exact} | {
        name: CodeScorer(scene.decode, table, exact.temperature, exact.max_mb)
        for name, table in tables.items()
    }
    compared = {name: _Comparison(scorer) for name, scorer in scorers.items()}
    photos = [photo for photo in scene.file.photos if photo.split == "eval"][: settings.photos]
    with progress_bar() as bar:
        for photo in bar.track(photos, description="comparing on held-out photos"):
            _compare(compared, scene, photo, queries, prompts, truth)
    view = scene.render(_frame(photos[0].camera, *settings.frame))
    milliseconds = _time(scorers, tables, scene, view, queries, settings.repeats, clock)
    rows = []
    for name, table in tables.items():
        error = table_error(torch.cat(compared[EXACT].sampled, 1), torch.cat(compared[name].sampled, 1))
        rows.append(
            {
                "size": table.size,
                "vertices": len(table.features),
                "megabytes": table.megabytes,
                "build_seconds": built[name],
                "query_ms": milliseconds[f"text {name}"],
                "frame_ms": milliseconds[name],
                **asdict(error),
                "decoded": sum(compared[name].decoded) / len(photos),
                "map": mean_average_precision(mean_over_photos(compared[name].scores)),
            }
        )
    return {
        "machine": describe_machine(scene.device),
        "clock": "wall-clock" if wall else "the processor's, which other processes leave alone",
        "prompts": prompts,
        "photos": [photo.name for photo in photos],
        "gaussians": len(scene.gaussians["means"]),
        "channels": queries.vectors.shape[1],
        "codes": len(codes),
        "tolerance": scene.config.lookup.tolerance,
        "seen": float((view.alpha >= scene.config.min_alpha).float().mean()),
        "render_ms": milliseconds["render"],
        "exact_ms": milliseconds[EXACT],
        "exact_map": mean_average_precision(mean_over_photos(compared[EXACT].scores)),
        "tables": rows,
    }


def _ground_truth(scene: Scene, settings: LookupBenchmark) -> GroundTruth | None:
    folder = settings.ground_truth or find_ground_truth(Path(scene.file.data))
    return GroundTruth(folder) if folder else None


def _frame(camera: Camera, width: int, height: int) -> Camera:
    """The camera with as many pixels as asked, of whatever proportions."""
    zoom = torch.tensor([[width / camera.width], [height / camera.height], [1.0]])
    return Camera(camera.view_matrix, camera.intrinsics * zoom, width, height)


def _compare(
    compared: dict[str, _Comparison],
    scene: Scene,
    photo: ScenePhoto,
    queries: Queries,
    prompts: list[str],
    truth: GroundTruth | None,
) -> None:
    view = scene.render(photo.camera)
    keep = view.alpha >= scene.config.min_alpha
    size = scoring_size(photo.height, photo.width)
    truths = truth.truths(photo.name, size) if truth else {}
    pixels = keep.flatten().nonzero()[:, 0]
    order = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0)).to(pixels.device)
    pixels = pixels[order[:_PIXELS_PER_PHOTO]]
    for found in compared.values():
        maps = found.scorer.relevancy(view.codes, queries, keep)
        found.sampled.append(maps.flatten(1)[:, pixels])
        found.scores.append(score_maps(dict(zip(prompts, resize_map(maps, size), strict=True)), truths))
        if found.scorer.table is not None:
            known = found.scorer.table.locate(view.codes[keep])[2]
            found.decoded.append(1 - float(known.float().mean()))


def _time(
    scorers: dict[str, CodeScorer],
    tables: dict[str, CodeTable],
    scene: Scene,
    view: View,
    queries: Queries,
    repeats: int,
    clock: Callable[[], float],
) -> dict[str, float]:
    """Median milliseconds of a render, of each scorer's frame for one prompt, and of a new text per table."""
    one = Queries(queries.vectors, queries.positive[:1], queries.negative[:1])
    keep = view.alpha >= scene.config.min_alpha

    def frame(scorer: CodeScorer) -> Callable[[], object]:
        return lambda: scorer.relevancy(view.codes, one, keep)

    def new_text(table: CodeTable) -> Callable[[], object]:
        # A copy with a sign changed is a text that the table wasn't asked before.
        texts = iter([one.vectors * (-1) ** i for i in range(repeats + 1)])
        return lambda: table.cosines(next(texts))

    frames = {name: frame(scorer) for name, scorer in scorers.items()}
    times = interleaved_times({"render": lambda: scene.render(view.camera)} | frames, repeats, clock=clock)
    texts = {f"text {name}": new_text(table) for name, table in tables.items()}
    times |= interleaved_times(texts, repeats, clock=clock)
    return {name: 1000 * median(seconds) for name, seconds in times.items()}


# ── the report ──────────────────────────────────────────────────────────────────────────────────────────


def markdown(settings: LookupBenchmark, results: dict[str, Any]) -> str:
    """The report."""
    exact_map, exact_ms = results["exact_map"], results["exact_ms"]

    def precision(row: dict[str, Any]) -> str | None:
        return None if exact_map is None else f"{row['map'] - exact_map:+.4f}"

    table = markdown_table(
        ["cells per axis", "mean error", "99.9th percentile", "across 0.5", "AP difference",
         "decoded exactly", "table", "build", "new text", "frame", "against exact"],
        [
            [r["size"], f"{r['mean']:.4f}", f"{r['p999']:.4f}", f"{r['flips']:.2%}", precision(r),
             f"{r['decoded']:.2%}", f"{r['megabytes']:.1f} MB", f"{r['build_seconds']:.2f} s",
             f"{r['query_ms']:.1f} ms", f"{r['frame_ms']:.1f} ms",
             f"{exact_ms / r['frame_ms']:.0f}× faster"]
            for r in results["tables"]
        ]
        + [[EXACT, None, None, None, None if exact_map is None else f"AP {exact_map:.4f}", "100 %",
            None, None, None, f"{exact_ms:.1f} ms", None]],
    )  # fmt: skip
    width, height = settings.frame
    return f"""# The lookup table: error against time

    {command_line("lang3dxl benchmark lookup", settings)}

{results["gaussians"]} Gaussians, {results["channels"]} channels; {len(results["photos"])} held-out photos;
prompts {", ".join(results["prompts"])}. {results["machine"]}. Times are {results["clock"]}.

{table}

Errors are of relevancy, 0…1, over the pixels that show something. "Decoded exactly" is the share of those
that lie where the table knows nothing, or would be off by more than {results["tolerance"]}. A frame has
{width}×{height} pixels ({results["seen"]:.0%} show something) and is answered for one prompt, rendering
({results["render_ms"]:.0f} ms) aside; "new text" is what a frame costs more when the prompt changes.

![Error against time](lookup.png)
"""


def plot(results: dict[str, Any]) -> bytes:
    """PNG: errors of each table against the time of a frame with it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    rows = results["tables"]
    megabytes = [row["megabytes"] for row in rows]
    for name, label, style in (("p999", "99.9th percentile", "o-"), ("mean", "mean", "s-")):
        axes.plot(megabytes, [max(row[name], 1e-6) for row in rows], style, label=label)
    for row in rows:
        note = f"{row['size']}³\n{row['frame_ms']:.0f} ms"
        axes.annotate(note, (row["megabytes"], max(row["p999"], 1e-6)), (5, 5), textcoords="offset points")
    axes.axhline(0.01, color="0.6", linestyle=":", linewidth=1)
    axes.set(xscale="log", yscale="log", xlabel="table, MB", ylabel="error of relevancy")
    axes.set_title(f"exact: {results['exact_ms']:.0f} ms per frame", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()
