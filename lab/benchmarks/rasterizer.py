"""`python -m lab.benchmarks.rasterizer`: time, memory and error beside a plain dense rasterizer.

Absolute times don't carry over to another machine; ratios between candidates that ran in turn do, so
quote those.
"""

import io
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from lab.benchmarks.dense_rasterizer import (
    DENSE_BYTES_PER_PAIR,
    DENSE_TILE,
    count_pairs,
    render_dense,
)
from lab.benchmarks.interleaved import interleaved_times
from lab.benchmarks.peak_memory import MEBIBYTE, peak_memory
from lab.benchmarks.rasterizer_scenes import (
    CHANNELS,
    COLORS,
    Case,
    Problem,
    Recipe,
    make_problem,
)
from lab.reports import command_line
from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.common.device import best_device
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.common.image import resize_nearest
from lang3dxl_ns.common.kernels import takes_kernels
from lang3dxl_ns.common.reports import describe_machine, markdown_table, write_report
from lang3dxl_ns.rendering import Backend, rasterize
from lang3dxl_ns.rendering.rasterize import EPS2D, at_fewer_pixels
from lang3dxl_ns.scene.camera import Camera

OURS, TORCH, DENSE, GSPLAT = "lang3dxl", "torch kernels", "dense tiles", "gsplat"
"""Methods that can be compared."""


# --- measuring --------------------------------------------------------------------------------------------


def forward(problem: Problem, method: str) -> tuple[Float[Tensor, "h w 6"], Float[Tensor, "h w 1"]]:
    """Image and alpha by one of the methods compared."""
    if method == DENSE:
        return render_dense(problem)
    backend: Backend = "gsplat" if method == GSPLAT else "torch"
    if method == OURS and takes_kernels(problem.channels, wanted="numba"):
        backend = "numba"
    scene = problem.gaussians, problem.camera, problem.channels, problem.background
    rendering = rasterize(*scene, backend=backend)
    return rendering.image, rendering.alpha


def forward_only(problem: Problem, method: str) -> Tensor:
    """The image, without keeping anything for a backward pass."""
    with torch.no_grad():
        return forward(problem, method)[0]


def forward_backward(problem: Problem, method: str) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The image and the gradients of the problem's leaves."""
    image, alpha = forward(problem, method)
    upstream = (problem.image_gradient, problem.alpha_gradient)
    return image.detach(), torch.autograd.grad((image, alpha), problem.leaves, upstream)


def error_against(
    result: tuple[Tensor, tuple[Tensor, ...]], reference: tuple[Tensor, tuple[Tensor, ...]]
) -> dict[str, float]:
    """Error of an image in [0, 1] and, relative L2, of the worst gradient.

    Where rounding moves a pair across the threshold of 1/255 (or of the stop at 1e-4), that pixel changes by
    up to about 2e-3: pixels off by more than 1e-4 are counted separately.
    """
    difference = (result[0].double() - reference[0].double()).abs()
    gradients = [
        float((ours.double() - true.double()).norm() / true.double().norm().clamp_min(1e-30))
        for ours, true in zip(result[1], reference[1], strict=True)
    ]
    return {
        "image_max": float(difference.max()),
        "image_mean": float(difference.mean()),
        "pixels_off": int((difference.amax(2) > 1e-4).sum()),
        "gradient": max(gradients),
    }


def pass_costs(problem: Problem) -> dict[str, Callable[[], object]]:
    """Forward and backward of colors with and without features: in one pass, in a second one, and in a second
    one at a fifth of the size, in which training draws what it decodes."""
    gaussians, camera, background = problem.gaussians, problem.camera, problem.background[:COLORS]
    colors, features = (
        part.clone().requires_grad_()
        for part in problem.channels.detach().split([COLORS, CHANNELS - COLORS], dim=1)
    )
    color_gradient, feature_gradient = problem.image_gradient.split([COLORS, CHANNELS - COLORS], dim=2)
    leaves = (*problem.leaves[:-1], colors, features)
    small, eps2d = at_fewer_pixels(camera, -(-camera.height // 5), -(-camera.width // 5))

    def one_pass() -> object:
        black = torch.zeros(CHANNELS - COLORS).to(background)
        values = torch.cat([colors, features], dim=1)
        result = rasterize(gaussians, camera, values, torch.cat([background, black]))
        upstream = problem.image_gradient, problem.alpha_gradient
        return torch.autograd.grad((result.image, result.alpha), leaves, upstream)

    def passes(second: Camera | None, eps2d: float = EPS2D) -> object:
        first = rasterize(gaussians, camera, colors, background)
        outputs, upstream = [first.image, first.alpha], [color_gradient, problem.alpha_gradient]
        if second is not None:
            outputs.append(rasterize(gaussians, second, features, eps2d=eps2d).image)
            upstream.append(resize_nearest(feature_gradient, (second.height, second.width)))
        return torch.autograd.grad(outputs, leaves, upstream, allow_unused=True)

    return {
        "colors alone": lambda: passes(None),
        "features in one pass": one_pass,
        "features in a second pass": lambda: passes(camera),
        "features in a small second pass": lambda: passes(small, eps2d),
    }


def prepared_pass(
    case: Case, scene: Path | None, device: str, threads: int, seed: int, method: str
) -> Callable[[], object]:
    """For `peak_memory`: forward and backward, with the libraries already loaded by a tiny rendering."""
    torch.set_num_threads(threads)
    forward_backward(make_problem(Case("A", 16, 16, 16), None, device), method)
    problem = make_problem(case, scene, device, seed=seed)
    return lambda: forward_backward(problem, method)


# --- the command --------------------------------------------------------------------------------------------


@dataclass
class RasterizerBenchmark:
    """Measure time, memory and error of the rasterizer, beside a dense one and, on a GPU, gsplat."""

    out: Path
    """Folder for rasterizer.md, rasterizer.json and rasterizer.png."""
    scene: Path | None = None
    """Points: an npz like gsplat's test_garden.npz. Default: a synthetic scene with similar statistics."""
    gaussians: tuple[int, ...] = (5_000, 20_000, 100_000)
    """Number of Gaussians."""
    image_sizes: tuple[tuple[int, int], ...] = ((160, 120), (320, 240), (640, 480))
    """Widths and heights, pixels."""
    recipes: tuple[Recipe, ...] = ("A", "B")
    """A: random small Gaussians. B: sizes and opacities as in training."""
    threads: int = 1
    """CPU threads. With one, processor time is measured, otherwise wall time."""
    repeats: int = 5
    """Runs of each candidate after a warm-up; the median is reported."""
    candidate_seconds: float = 5.0
    """A candidate that takes longer in total is repeated less often (at least once)."""
    baseline_gigabytes: float = 4.0
    """The dense baseline's backward pass is skipped if it would need more memory than this."""
    device: str = "auto"
    """Device: auto (a GPU if there is one), cpu, cuda."""
    seed: int = 0
    """Random seed."""
    quick: bool = False
    """Two small cases in seconds, as a smoke test; not for quoting."""

    def main(self) -> None:
        """Measure, and write the report."""
        device = self.device
        if device == "auto":
            device = best_device()
        plan = replace(self, device=device)
        if self.quick:
            plan = replace(plan, gaussians=(1_000,), image_sizes=((80, 60),), repeats=2)
        threads_before = torch.get_num_threads()
        torch.set_num_threads(self.threads)
        try:
            results = {
                "command": command_line("python -m lab.benchmarks.rasterizer", self),
                "machine": describe_machine(device),
                "points": self.scene.name if self.scene else "synthetic scene",
                "baseline_gigabytes": self.baseline_gigabytes,
                **_measure(plan),
            }
        finally:
            torch.set_num_threads(threads_before)
        write_report(self.out, "rasterizer", _markdown(results), results)
        write_atomically(self.out / "rasterizer.png", _plot(results))


def _measure(plan: RasterizerBenchmark) -> dict[str, Any]:
    cases = [
        Case(recipe, count, width, height)
        for recipe in plan.recipes
        for count in plan.gaussians
        for width, height in plan.image_sizes
    ]
    trained = [case for case in cases if case.recipe == plan.recipes[-1]]
    # Features: from few Gaussians on a small image to many on a large one, not every combination.
    diagonal = trained[:: len(plan.image_sizes) + 1]
    results: dict[str, list] = {"cases": [], "passes": []}
    for case in tracked(cases, "rasterizer"):
        results["cases"].append(_measure_case(case, plan))
    for case in tracked(diagonal, "passes"):
        problem = make_problem(case, plan.scene, plan.device, seed=plan.seed)
        results["passes"].append({**vars(case), "ms": _median_ms(pass_costs(problem), plan)})
    return results


def _measure_case(case: Case, plan: RasterizerBenchmark) -> dict[str, Any]:
    problem = make_problem(case, plan.scene, plan.device, seed=plan.seed)
    own = [OURS, DENSE, GSPLAT] if plan.device == "cuda" else [OURS, TORCH, DENSE]
    methods = {name: name for name in own}
    kept, evaluated = count_pairs(problem.gaussians, problem.camera)
    need = evaluated * DENSE_BYTES_PER_PAIR / 1e9
    forward_ms = _median_ms({name: partial(forward_only, problem, m) for name, m in methods.items()}, plan)
    if need > plan.baseline_gigabytes:
        del methods[DENSE]
    both_ms = _median_ms({name: partial(forward_backward, problem, m) for name, m in methods.items()}, plan)

    # The dense baseline is the independent reference where it fits: float64 takes twice the memory.
    reference_method = DENSE if 2 * need <= plan.baseline_gigabytes else OURS
    exact = make_problem(case, plan.scene, plan.device, torch.float64, plan.seed)
    reference = forward_backward(exact, reference_method)
    setup = (case, plan.scene, plan.device, plan.threads, plan.seed)
    return {
        **vars(case),
        "kept_pairs": kept,
        "dense_pairs": evaluated,
        "dense_gigabytes": need,
        "forward_ms": forward_ms,
        "forward_backward_ms": both_ms,
        "reference": reference_method,
        "error": {
            name: error_against(forward_backward(problem, m), reference) for name, m in methods.items()
        },
        "peak_mib": {name: peak_memory(prepared_pass, *setup, m) / MEBIBYTE for name, m in methods.items()},
    }


def _median_ms(candidates: dict[str, Callable[[], object]], plan: RasterizerBenchmark) -> dict[str, float]:
    alone = plan.device == "cpu" and plan.threads == 1
    clock = time.process_time if alone else time.perf_counter
    times = interleaved_times(candidates, plan.repeats, plan.candidate_seconds, clock)
    return {name: 1e3 * statistics.median(taken) for name, taken in times.items()}


# --- the report ---------------------------------------------------------------------------------------------


def _markdown(results: dict[str, Any]) -> str:
    others = list(results["cases"][0]["forward_ms"])[1:]
    header = ["recipe", "Gaussians", "image", "kept pairs", f"{OURS} ms (f / f+b)"]
    header += [f"{name} ms (f / f+b)" for name in others]
    header += [f"**{name} ÷ {OURS}** (f / f+b)" for name in others]
    errors = "recipe, Gaussians, image, candidate, image max, image mean, pixels off, gradients, peak MiB"
    passes = ["recipe", "Gaussians", "image", *results["passes"][0]["ms"]]
    return f"""# Rasterizer: time, error, memory

`{results["command"]}`
{results["machine"]}. Points: {results["points"]}.

{CHANNELS} channels (colors and features) over a background; gradients of image and alpha for all Gaussian
parameters and channels; projection included. Medians of interleaved runs; f: forward, f+b: forward and
backward. **Quote the ratios**: times don't carry over to another machine.
{TORCH}: the rasterizer in plain torch, for other devices and where numba is missing.
{DENSE}: the same rendering rules in plain torch with autograd, in tiles of {DENSE_TILE} pixels (the
fastest size); – where its backward pass would need more than {results["baseline_gigabytes"]:g} GB.

{markdown_table(header, [_time_row(case, others) for case in results["cases"]])}

## Error and memory

Against {DENSE} in float64 (†: too large for it; against {OURS} in float64), images in [0, 1]. Pixels off:
by more than 1e-4, where rounding moved a pair across the threshold of 1/255 or the stop at 1e-4. Gradients:
relative L2, the worst of means, rotations, scales, opacities, channels. Peak: extra memory of forward and
backward.

{markdown_table(errors.split(", "), (row for case in results["cases"] for row in _error_rows(case)))}

## Features beside the colors

{COLORS} colors, {CHANNELS - COLORS} features; forward and backward: ms, and the multiple of colors alone.

{markdown_table(passes, [_pass_row(row) for row in results["passes"]])}

![Time against size](rasterizer.png)
"""


def _case_cells(case: dict[str, Any]) -> list[str]:
    return [case["recipe"], f"{case['gaussians']:,}", f"{case['width']}×{case['height']}"]


def _time_row(case: dict[str, Any], others: list[str]) -> list[str]:
    forward_ms, both_ms = case["forward_ms"], case["forward_backward_ms"]

    def pair(name: str, unit_forward: float, unit_both: float) -> str:
        both = _number(both_ms[name] / unit_both) if name in both_ms else "–"
        return f"{_number(forward_ms[name] / unit_forward)} / {both}"

    cells = [*_case_cells(case), f"{case['kept_pairs'] / 1e6:.2f} M"]
    cells += [pair(name, 1, 1) for name in (OURS, *others)]
    return cells + [pair(name, forward_ms[OURS], both_ms[OURS]) for name in others]


def _number(value: float) -> str:
    return f"{value:,.{1 if value < 10 else 0}f}"


def _error_rows(case: dict[str, Any]) -> Iterable[list[str]]:
    mark = "" if case["reference"] == DENSE else " †"
    for name, error in case["error"].items():
        yield [
            *_case_cells(case),
            name + mark,
            f"{error['image_max']:.1e}",
            f"{error['image_mean']:.1e}",
            f"{error['pixels_off']}",
            f"{error['gradient']:.1e}",
            f"{case['peak_mib'][name]:,.0f}",
        ]


def _pass_row(row: dict[str, Any]) -> list[str]:
    alone = row["ms"]["colors alone"]
    return [*_case_cells(row), *(f"{_number(ms)} (×{ms / alone:.2f})" for ms in row["ms"].values())]


def _plot(results: dict[str, Any]) -> bytes:
    """PNG: forward and backward time against the number of Gaussians, a panel per recipe."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullFormatter

    cases = results["cases"]
    methods = list(cases[0]["forward_ms"])
    sizes = sorted({(case["width"], case["height"]) for case in cases})
    colors = dict(zip(sizes, ("#7fb3d5", "#2471a3", "#0b2545", "#6c3483"), strict=False))
    styles = dict(zip(methods, cycle(("o-", "s--", "^:", "v-.", "D--", "P:")), strict=False))
    recipes = {"A": "A: random small Gaussians", "B": "B: as in training"}
    drawn = [recipe for recipe in recipes if any(case["recipe"] == recipe for case in cases)]
    figure = Figure(figsize=(4.6 * len(drawn), 4.2), layout="constrained")
    panels = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
    for panel, recipe in zip(panels, drawn, strict=True):
        for size in sizes:
            line = [
                case for case in cases if case["recipe"] == recipe and (case["width"], case["height"]) == size
            ]
            for method in methods:
                both = [case["forward_backward_ms"].get(method, float("nan")) for case in line]
                count = [case["gaussians"] for case in line]
                panel.plot(count, both, styles[method], color=colors[size], markersize=4.5, linewidth=1.6)
        panel.set(xscale="log", yscale="log", xlabel="Gaussians", title=recipes[recipe])
        counts = sorted({case["gaussians"] for case in cases})
        panel.set_xticks(counts, [f"{count:,}" for count in counts])
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.yaxis.set_major_formatter("{x:,g}")
        panel.grid(which="major", alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("forward + backward, ms")
    keys = [Line2D([], [], color=colors[size], linewidth=3, label=f"{size[0]}×{size[1]}") for size in sizes]
    figure.legend(handles=keys, loc="outside lower center", ncols=len(keys), frameon=False)
    keys = [
        Line2D([], [], color="0.35", marker=styles[m][0], linestyle=styles[m][1:], label=m) for m in methods
    ]
    figure.legend(handles=keys, loc="outside upper center", ncols=2 * len(drawn), frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()


if __name__ == "__main__":
    tyro.cli(RasterizerBenchmark).main()
