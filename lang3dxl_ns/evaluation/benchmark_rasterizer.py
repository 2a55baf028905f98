"""What the rasteriser costs and how wrong it is, beside a plain dense one in the same process.

Absolute times don't carry over from one machine to the next; the ratios between candidates that ran in turn
do, so those are the figures to quote.
"""

import io
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.report import (
    MEBIBYTE,
    command_line,
    describe_machine,
    interleaved_times,
    markdown_table,
    peak_memory,
    progress_bar,
    write_atomically,
    write_report,
)
from lang3dxl_ns.rendering import Camera, Gaussians, rasterize
from lang3dxl_ns.rendering.rasterize import Backend

Recipe = Literal["A", "B"]
OURS, DENSE, GSPLAT = "lang3dxl", "dense tiles", "gsplat"
CHANNELS, COLOURS = 6, 3


# --- scenes ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """One line of the report: how many Gaussians of which kind, on how many pixels."""

    recipe: Recipe
    gaussians: int
    width: int
    height: int


@dataclass
class Problem:
    """All that one rendering and its backward pass need; gradients are wanted for `leaves`."""

    gaussians: Gaussians
    camera: Camera
    channels: Float[Tensor, "n 6"]
    background: Float[Tensor, " 6"]
    image_gradient: Float[Tensor, "h w 6"]
    alpha_gradient: Float[Tensor, "h w 1"]

    @property
    def leaves(self) -> tuple[Tensor, ...]:
        g = self.gaussians
        return g.means, g.quats, g.scales, g.opacities, self.channels


def make_problem(
    case: Case, scene: Path | None, device: str = "cpu", dtype: torch.dtype = torch.float32, seed: int = 0
) -> Problem:
    """The same problem for the same case and seed, whatever the device and number type.

    Recipe A: random scales U(1e-4, 0.02), opacities U(0, 1). Recipe B, as in training: scales of the mean
    distance to the three nearest neighbours times a log-normal factor per axis, opacities sigmoid(N(0, 2)).
    """
    generator = torch.Generator().manual_seed(seed)
    points, camera = synthetic_cloud(case.gaussians, generator) if scene is None else load_cloud(scene)
    if len(points) < case.gaussians:
        raise UserError(
            f"{scene} has {len(points)} points within ±2, fewer than {case.gaussians}: lower --gaussians"
        )
    n = case.gaussians
    means = points[torch.randperm(len(points), generator=generator)[:n]]
    if case.recipe == "A":
        scales = torch.rand(n, 3, generator=generator) * (0.02 - 1e-4) + 1e-4
        opacities = torch.rand(n, generator=generator)
    else:
        scales = _neighbour_distance(means)[:, None] * torch.randn(n, 3, generator=generator).mul(0.5).exp()
        opacities = torch.sigmoid(2 * torch.randn(n, generator=generator))
    quats = torch.randn(n, 4, generator=generator)
    channels = torch.rand(n, CHANNELS, generator=generator)
    background = torch.rand(CHANNELS, generator=generator)
    image_gradient = torch.randn(case.height, case.width, CHANNELS, generator=generator)
    alpha_gradient = torch.randn(case.height, case.width, 1, generator=generator)

    def leaf(tensor: Tensor) -> Tensor:
        return tensor.to(device, dtype).requires_grad_()

    zoom = torch.tensor([case.width / camera.width, case.height / camera.height, 1.0])
    return Problem(
        Gaussians(leaf(means), leaf(quats), leaf(scales), leaf(opacities)),
        Camera(
            camera.view_matrix.to(device, dtype),
            (zoom[:, None] * camera.intrinsics).to(device, dtype),
            case.width,
            case.height,
        ),
        leaf(channels),
        background.to(device, dtype),
        image_gradient.to(device, dtype),
        alpha_gradient.to(device, dtype),
    )


def load_cloud(path: Path) -> tuple[Float[Tensor, "n 3"], Camera]:
    """Points within ±2 and the first camera of an npz in the layout of gsplat's `test_garden.npz`."""
    try:
        with np.load(path) as arrays:
            points = torch.from_numpy(arrays["means3d"]).float()
            view, intrinsics = (torch.from_numpy(arrays[name][0]).float() for name in ("viewmats", "Ks"))
            width, height = int(arrays["width"]), int(arrays["height"])
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"{path} is no scene for this benchmark ({error}): it takes an npz with means3d, viewmats, Ks, "
            "width and height, as gsplat's test_garden.npz; without --scene a made one is used"
        ) from error
    return points[points.abs().amax(1) < 2], Camera(view, intrinsics, width, height)


def synthetic_cloud(count: int, generator: torch.Generator) -> tuple[Float[Tensor, "n 3"], Camera]:
    """Points within ±2 on a ground, a round table, a ball on it and a round wall, seen from 1.6 away.

    Stands in for the garden: the same number of pairs of pixel and Gaussian within about a quarter.
    """

    def uniform(n: int, *ranges: tuple[float, float]) -> list[Tensor]:
        return [low + (high - low) * torch.rand(n, generator=generator) for low, high in ranges]

    turn = (0.0, 2 * torch.pi)
    ground, table, ball = (count * percent // 100 for percent in (30, 40, 10))
    x, y, z = uniform(ground, (-2, 2), (-2, 2), (-0.72, -0.7))
    area, angle, level = uniform(table, (0, 0.64), turn, (-0.01, 0.01))
    bearing, height, distance = uniform(count - ground - table - ball, turn, (-0.7, 1), (1.75, 1.85))
    sphere = torch.nn.functional.normalize(torch.randn(ball, 3, generator=generator), dim=1)
    points = [
        torch.stack([x, y, z], dim=1),
        torch.stack([area.sqrt() * angle.cos(), area.sqrt() * angle.sin(), level], dim=1),
        0.25 * sphere + torch.tensor([0, 0, 0.25]),
        torch.stack([distance * bearing.cos(), distance * bearing.sin(), height], dim=1),
    ]
    return torch.cat(points), _camera_towards_origin(torch.tensor([-1.4, -0.3, 0.7]))


def _camera_towards_origin(position: Float[Tensor, " 3"]) -> Camera:
    """A camera of 648×420 pixels (as the garden's) at a world position; the world's z points up."""
    forward = -position / position.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]))
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    view = torch.eye(4)
    view[:3, :3], view[:3, 3] = rotation, -rotation @ position
    return Camera(view, torch.tensor([[480.0, 0, 324], [0, 480.0, 210], [0, 0, 1]]), 648, 420)


def _neighbour_distance(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Mean distance to the three nearest other points."""
    from scipy.spatial import KDTree

    array = points.numpy()
    distances, _ = KDTree(array).query(array, k=min(4, len(array)))
    return torch.from_numpy(distances[:, 1:].mean(1)).float().clamp_min(1e-6)


# --- the baseline: dense, tile by tile, differentiated by autograd ------------------------------------------

DENSE_TILE = 16
"""Pixels per side. Of 16, 32 and 64 the fastest in every case measured, so the fairest to compare with."""
DENSE_BYTES_PER_PAIR = 55
"""What autograd keeps for every pixel and Gaussian of a tile, float32, measured."""


def render_dense(problem: Problem) -> tuple[Float[Tensor, "h w 6"], Float[Tensor, "h w 1"]]:
    """What a short rasteriser in plain torch looks like: every Gaussian of a tile at every pixel of it.

    Follows gsplat's rules of rendering, but shares no code with `rasterize`: also its reference in float64.
    """
    columns = -(-problem.camera.width // DENSE_TILE)
    payload = torch.cat([problem.channels, torch.ones_like(problem.channels[:, :1])], dim=1)
    tiles = _dense_tiles(problem)
    maps = [(weights @ payload.index_select(0, index)).unflatten(0, size) for index, weights, size in tiles]
    rows = [torch.cat(maps[first : first + columns], dim=1) for first in range(0, len(maps), columns)]
    image, alpha = torch.cat(rows).split([CHANNELS, 1], dim=2)
    return image + (1 - alpha) * problem.background, alpha


@torch.no_grad()
def count_pairs(problem: Problem) -> tuple[int, int]:
    """Pairs of a pixel and a Gaussian: those that contribute, and those that `render_dense` evaluates."""
    counts = [(int((weights > 0).sum()), weights.numel()) for _, weights, _ in _dense_tiles(problem)]
    kept, evaluated = (sum(column) for column in zip(*counts, strict=True))
    return kept, evaluated


def _dense_tiles(
    problem: Problem,
) -> Iterator[tuple[Int[Tensor, " m"], Float[Tensor, "p m"], tuple[int, int]]]:
    """For every tile, row by row: its Gaussians front to back, their weights in each pixel, its size."""
    camera = problem.camera
    order, centres, conics, opacities, reach = _splats(problem)
    with torch.no_grad():
        low, high = centres - reach, centres + reach
    for top in range(0, camera.height, DENSE_TILE):
        for left in range(0, camera.width, DENSE_TILE):
            right, bottom = min(left + DENSE_TILE, camera.width), min(top + DENSE_TILE, camera.height)
            inside = (high > high.new_tensor([left, top])) & (low < low.new_tensor([right, bottom]))
            index = inside.all(1).nonzero().squeeze(1)
            grid = torch.cartesian_prod(torch.arange(top, bottom), torch.arange(left, right)).to(centres)
            y, x = grid.unbind(1)
            u, v = centres.index_select(0, index).unbind(1)
            a, b, c = conics.index_select(0, index).unbind(1)
            dx, dy = x[:, None] + 0.5 - u, y[:, None] + 0.5 - v
            falloff = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            alpha = falloff * opacities.index_select(0, index)
            alpha = torch.where(alpha < 1 / 255, 0.0, alpha.clamp_max(0.999))
            after = torch.cumprod(1 - alpha, dim=1)
            before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
            yield order[index], torch.where(after > 1e-4, alpha * before, 0.0), (bottom - top, right - left)


def _splats(problem: Problem) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Of all in front of the camera, front to back: index, centre, conic, opacity, reach along x and y."""
    gaussians, camera = problem.gaussians, problem.camera
    rotation, offset = camera.view_matrix[:3, :3], camera.view_matrix[:3, 3]
    points = gaussians.means @ rotation.T + offset
    with torch.no_grad():
        order = ((points[:, 2] > 0.01) & (gaussians.opacities >= 1 / 255)).nonzero().squeeze(1)
        order = order[points[order, 2].argsort(stable=True)]
    opacities, (x, y, z) = gaussians.opacities[order], points[order].unbind(1)
    focal, centre = camera.intrinsics.diagonal()[:2], camera.intrinsics[:2, 2]
    size = focal.new_tensor([camera.width, camera.height])
    slopes = torch.stack([x / z, y / z], dim=1)
    margin = 0.15 * size  # gsplat's: 0.3 of half the image, beyond which the affine approximation is bad
    held = slopes.clamp((-centre - margin) / focal, (size - centre + margin) / focal)
    jacobian = torch.cat([torch.eye(2).to(held).expand(len(held), 2, 2), -held[:, :, None]], dim=2)
    jacobian = jacobian * (focal[:, None] / z[:, None, None])
    axes = jacobian @ rotation @ (_rotations(gaussians.quats[order]) * gaussians.scales[order, None])
    covariances = axes @ axes.mT + 0.3 * torch.eye(2).to(axes)
    (xx, xy), (_, yy) = (row.unbind(1) for row in covariances.unbind(1))
    conics = torch.stack([yy, -xy, xx], dim=1) / (xx * yy - xy * xy)[:, None]
    with torch.no_grad():
        reach = (2 * torch.log(255 * opacities)[:, None] * torch.stack([xx, yy], dim=1)).sqrt()
    return order, slopes * focal + centre, conics, opacities, reach


def _rotations(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """R = I + 2w[v]ₓ + 2[v]ₓ² for the unit quaternion (w, v)."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).view(-1, 3, 3)
    return torch.eye(3).to(quats) + 2 * w[:, None, None] * cross + 2 * cross @ cross


# --- measuring --------------------------------------------------------------------------------------------


def forward(problem: Problem, method: str) -> tuple[Float[Tensor, "h w 6"], Float[Tensor, "h w 1"]]:
    """Image and alpha by one of the methods compared."""
    if method == DENSE:
        return render_dense(problem)
    backend: Backend = "gsplat" if method == GSPLAT else "torch"
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
    """Error of an image in [0, 1] and, relative L2, of the worst of the gradients.

    Where rounding moves a pair over the threshold of 1/255 (or of the end of a pixel), that pixel changes by
    up to about 2e-3: pixels off by more than 1e-4 are counted apart.
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
    """Forward and backward of colours with and without the features, in the ways there are to get both."""
    gaussians, camera, background = problem.gaussians, problem.camera, problem.background[:COLOURS]
    colours, features = (
        part.clone().requires_grad_()
        for part in problem.channels.detach().split([COLOURS, CHANNELS - COLOURS], dim=1)
    )
    colour_gradient, feature_gradient = problem.image_gradient.split([COLOURS, CHANNELS - COLOURS], dim=2)
    leaves = (*problem.leaves[:-1], colours, features)

    def one_pass(detach: bool) -> object:
        result = rasterize(gaussians, camera, colours, background, features=features, detach_features=detach)
        outputs: Any = (result.image, result.alpha, result.features)
        return torch.autograd.grad(
            outputs, leaves, (colour_gradient, problem.alpha_gradient, feature_gradient)
        )

    def passes(second: Gaussians | None) -> object:
        first = rasterize(gaussians, camera, colours, background)
        outputs, upstream = [first.image, first.alpha], [colour_gradient, problem.alpha_gradient]
        if second is not None:
            outputs.append(rasterize(second, camera, features).image)
            upstream.append(feature_gradient)
        return torch.autograd.grad(outputs, leaves, upstream, allow_unused=True)

    return {
        "colours alone": lambda: passes(None),
        "one pass, features detached": lambda: one_pass(True),
        "one pass, features move the geometry": lambda: one_pass(False),
        "two passes, features detached": lambda: passes(gaussians.detach()),
        "two passes, features move the geometry": lambda: passes(gaussians),
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
    """Measure time, memory and error of the rasteriser, beside a dense one and, on a GPU, gsplat."""

    out: Path
    """Folder for rasterizer.md, rasterizer.json and rasterizer.png."""
    scene: Path | None = None
    """Points to use, an npz like gsplat's test_garden.npz. Without it, a made scene of similar statistics."""
    gaussians: tuple[int, ...] = (5_000, 20_000, 100_000)
    """How many Gaussians."""
    image_sizes: tuple[tuple[int, int], ...] = ((160, 120), (320, 240), (640, 480))
    """Widths and heights, pixels."""
    recipes: tuple[Recipe, ...] = ("A", "B")
    """A: random small Gaussians. B: sizes and opacities as in training."""
    threads: int = 1
    """CPU threads. On one thread processor time is measured, else wall time."""
    repeats: int = 5
    """Runs of each candidate after a warm-up; the median counts."""
    candidate_seconds: float = 5.0
    """A candidate slower than this altogether is repeated less often (at least one run)."""
    baseline_gigabytes: float = 4.0
    """The dense baseline's backward pass is left out where it would need more memory than this."""
    device: str = "auto"
    """Where to render: auto (a GPU if there is one), cpu, cuda."""
    seed: int = 0
    """Seed of everything random."""
    quick: bool = False
    """Two small cases in seconds, to see that it works; no figures to quote."""

    def main(self) -> None:
        """Measure, and write the report."""
        device = self.device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        plan = replace(self, device=device)
        if self.quick:
            plan = replace(plan, gaussians=(1_000,), image_sizes=((80, 60),), repeats=2)
        threads_before = torch.get_num_threads()
        torch.set_num_threads(self.threads)
        try:
            results = {
                "command": command_line("lang3dxl benchmark rasterizer", self),
                "machine": describe_machine(device),
                "points": self.scene.name if self.scene else "made scene",
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
    with progress_bar() as bar:
        weights = [3e9 + case.gaussians * case.width * case.height for case in cases]  # roughly the time
        task = bar.add_task("rasteriser", total=sum(weights) + 3e9 * len(diagonal))
        for case, weight in zip(cases, weights, strict=True):
            results["cases"].append(_measure_case(case, plan))
            bar.advance(task, weight)
        for case in diagonal:
            problem = make_problem(case, plan.scene, plan.device, seed=plan.seed)
            results["passes"].append({**vars(case), "ms": _median_ms(pass_costs(problem), plan)})
            bar.advance(task, 3e9)
    return results


def _measure_case(case: Case, plan: RasterizerBenchmark) -> dict[str, Any]:
    problem = make_problem(case, plan.scene, plan.device, seed=plan.seed)
    methods = [OURS, DENSE] + ([GSPLAT] if plan.device == "cuda" else [])
    kept, evaluated = count_pairs(problem)
    need = evaluated * DENSE_BYTES_PER_PAIR / 1e9
    differentiated = [method for method in methods if method != DENSE or need <= plan.baseline_gigabytes]
    forward_ms = _median_ms({method: partial(forward_only, problem, method) for method in methods}, plan)
    both_ms = _median_ms(
        {method: partial(forward_backward, problem, method) for method in differentiated}, plan
    )

    # The dense baseline is the independent reference, as far as it fits: float64 takes twice the memory.
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
        "error": {m: error_against(forward_backward(problem, m), reference) for m in differentiated},
        "peak_mib": {m: peak_memory(prepared_pass, *setup, m) / MEBIBYTE for m in differentiated},
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
    return f"""# Rasteriser: time, error, memory

`{results["command"]}`
{results["machine"]}. Points: {results["points"]}.

{CHANNELS} channels (colours and features) over a background; gradients of image and alpha to all Gaussian
parameters and channels; projection included. Medians of runs that took turns; f: forward, f+b: forward and
backward. **Quote the ratios**: times don't carry over to another machine.
{DENSE}: the same rules of rendering in plain torch with autograd, in tiles of {DENSE_TILE} pixels (the
fastest size); – where its backward pass would need more than {results["baseline_gigabytes"]:g} GB.

{markdown_table(header, [_time_row(case, others) for case in results["cases"]])}

## Error and memory

Against {DENSE} in float64 (†: too large for it; against {OURS} in float64), images in [0, 1]. Pixels off:
by more than 1e-4, where rounding moved a pair over the threshold of 1/255 or the end of a pixel. Gradients:
relative L2, the worst of means, rotations, scales, opacities, channels. Peak: extra memory of forward and
backward.

{markdown_table(errors.split(", "), (row for case in results["cases"] for row in _error_rows(case)))}

## Features beside the colours

{COLOURS} colours, {CHANNELS - COLOURS} features; forward and backward: ms, and the multiple of colours alone.

{markdown_table(passes, [_pass_row(row) for row in results["passes"]])}

![Time against size](rasterizer.png)
"""


def _case_cells(case: dict[str, Any]) -> list[str]:
    return [case["recipe"], f"{case['gaussians']:,}", f"{case['width']}×{case['height']}"]


def _time_row(case: dict[str, Any], others: list[str]) -> list[str]:
    forward_ms, both_ms = case["forward_ms"], case["forward_backward_ms"]

    def pair(name: str, unit_forward: float, unit_both: float, style: str) -> str:
        both = format(both_ms[name] / unit_both, style) if name in both_ms else "–"
        return f"{format(forward_ms[name] / unit_forward, style)} / {both}"

    cells = [*_case_cells(case), f"{case['kept_pairs'] / 1e6:.2f} M"]
    cells += [pair(name, 1, 1, ",.0f") for name in (OURS, *others)]
    return cells + [pair(name, forward_ms[OURS], both_ms[OURS], ".2g") for name in others]


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
    alone = row["ms"]["colours alone"]
    return [*_case_cells(row), *(f"{ms:,.0f} (×{ms / alone:.2f})" for ms in row["ms"].values())]


def _plot(results: dict[str, Any]) -> bytes:
    """PNG: forward and backward time against the number of Gaussians, a panel for each recipe."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullFormatter

    cases = results["cases"]
    methods = list(cases[0]["forward_ms"])
    sizes = sorted({(case["width"], case["height"]) for case in cases})
    colours = dict(zip(sizes, ("#7fb3d5", "#2471a3", "#0b2545", "#6c3483"), strict=False))
    styles = dict(zip(methods, ("o-", "s--", "^:"), strict=False))
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
                panel.plot(count, both, styles[method], color=colours[size], markersize=4.5, linewidth=1.6)
        panel.set(xscale="log", yscale="log", xlabel="Gaussians", title=recipes[recipe])
        counts = sorted({case["gaussians"] for case in cases})
        panel.set_xticks(counts, [f"{count:,}" for count in counts])
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.yaxis.set_major_formatter("{x:,g}")
        panel.grid(which="major", alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("forward + backward, ms")
    keys = [Line2D([], [], color=colours[size], linewidth=3, label=f"{size[0]}×{size[1]}") for size in sizes]
    keys += [
        Line2D([], [], color="0.35", marker=styles[m][0], linestyle=styles[m][1:], label=m) for m in methods
    ]
    figure.legend(handles=keys, loc="outside lower center", ncols=len(keys), frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()
