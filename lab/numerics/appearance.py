"""Hard cases of the appearance field: extreme positions, colors and photo vectors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor
from torch.func import functional_call
from torch.nn.functional import linear

from lab.numerics.hash_grid import interpolate_reference
from lab.numerics.measure import EXACT, Bounds, Case, Maps, Problem
from lang3dxl_ns.components.appearance import FIRST_LOGIT, TEMPERATURE, AppearanceConfig, AppearanceField
from lang3dxl_ns.rendering import Gaussians

COUNT = 200
BOUNDS = {"float32": Bounds(2e-5, 5e-6, 1e-3, 1e-4), "float64": EXACT}
HALF = {"bf16": Bounds(3e-2, 1e-2, 0.5, 0.2), "fp16": Bounds(1e-3, 5e-4, 0.1, 0.04)}
"""Bounds of mixed precision: a ReLU that rounding opens or closes changes a whole row's gradient. In 16 draws
of the numbers, half of them with an earlier, finer grid, fp16 had errors of 1e-3 to .08, RMS .001 to .036."""


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Yield cases of colors, and of opacities with the opacity shift, under a photo's look."""
    cell = "a rounded place may lie in the next cell of the grid"
    catalog: dict[str, tuple[Callable[[], Problem], str]] = {
        "usual": (_problem, ""),
        "as published (fine grid)": (partial(_problem, preset="paper"), cell),
        "opacity shift": (partial(_problem, shift=True), ""),
        "opacity shift, logits of 1e4": (partial(_problem, shift=True, loudness=1e5), ""),
        "vector of 0": (partial(_problem, vector=0.0), ""),
        "vector of 1e4": (partial(_problem, vector=1e4), ""),
        "black": (partial(_problem, color=0.0), ""),
        "exposure 100× and 1/100": (partial(_problem, color=100.0), ""),
        "places 1e-3 wide": (partial(_problem, radius=1e-3), ""),
        "places 1e5 wide": (partial(_problem, radius=1e5), ""),
        "places at 1e9 and 1e30 radii": (partial(_problem, far=True), "as far as the sky: the ball's border"),
        "all places in one point": (partial(_problem, radius=0.0), ""),
        "no Gaussian in view": (partial(_problem, visible=0), ""),
        "NaN in some places": (partial(_problem, broken=True), "NaN in its own row, nowhere else"),
    }
    for name, (build, note) in catalog.items():
        yield Case("appearance", name, build, BOUNDS, note)
    offset = {"float32": Bounds(2e-5, 5e-6, 1e-3, 1e-4), "float64": EXACT}
    note = "of places as float32 holds them, a quarter of a unit apart; the data parser moves scenes near 0"
    yield Case("appearance", "world offset 1e6 (UTM)", partial(_problem, offset=1e6), offset, note)
    note = "rounding may move a color or a ReLU over 0"
    yield Case("appearance", "mixed precision", _problem, HALF, note)


def _problem(
    preset: str = "coarse",
    shift: bool = False,
    loudness: float = 1.0,
    vector: float | None = None,
    color: float | None = None,
    radius: float = 1.0,
    offset: float = 0.0,
    visible: int = 150,
    far: bool = False,
    broken: bool = False,
) -> Problem:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    center = offset * torch.tensor([0.48, 4.6, 0.1])
    config = AppearanceConfig(preset=preset, opacity_shift=shift)  # type: ignore[arg-type]
    field = AppearanceField(config, ["a"], center, radius, generator=generator)
    field.grid.table.data *= 3000  # as large as after training
    field.output.weight.data = loudness * 0.1 * normal(*field.output.weight.shape).float()
    means = normal(COUNT, 3) * radius + center.double()
    if far:
        means[:20], means[20:40] = 1e9 * means[:20], 1e30 * means[20:40]
    if broken:
        means[3], means[8, 1] = math.nan, math.nan
    colors = torch.rand(COUNT, 3, generator=generator, dtype=torch.float64)
    if color is not None:
        colors = colors * torch.where(torch.arange(COUNT) % 2 == 0, color, 0.01 * color)[:, None]
    given = normal(config.vector_dim) if vector is None else vector * normal(config.vector_dim).sign()
    rows = torch.randperm(COUNT, generator=generator)[:visible]
    state = {name: value.detach().double() for name, value in field.named_parameters() if name != "vectors"}
    leaves = {"colors": colors, "vector": given, "opacities": colors[:, 0].clamp(0, 1), "means": means}
    constants = frozenset(state) | {"means"} if broken else frozenset({"means"})

    def compute(given: Maps) -> Maps:
        moved = field.to(given["means"].device, given["means"].dtype)
        size = len(given["means"])
        filler = torch.ones(size, 4).to(given["means"])
        gaussians = Gaussians(given["means"], filler, filler[:, :3], given["opacities"])
        parameters = {name: given[name] for name in state} | {"vectors": moved.vectors}
        arguments = (gaussians, given["colors"], given["vector"], rows.to(filler.device), 7)
        shifted, shown = functional_call(moved, parameters, arguments)
        return {"colors": shifted} | ({"opacities": shown.opacities} if shift else {})

    def reference(given: Maps) -> Maps:
        return appearance_reference(field, given, rows.to(given["means"].device))

    return Problem({**leaves, **state}, compute, reference, constants=constants, gradient_scale=1e-6)


def appearance_reference(field: AppearanceField, given: Maps, rows: Tensor) -> Maps:
    """Compute the field as documented: contract space, look up, apply three layers, shift and clamp."""
    x = (given["means"][rows] - field.center.double()) / field.radius.double()
    distance = x.norm(dim=1, keepdim=True).clamp_min(1)
    places = 0.5 + 0.25 * (x / distance) * (2 - 1 / distance)
    base = given["colors"][rows]
    features = torch.cat([interpolate_reference(field.grid, given["grid.table"], places), base], dim=1)
    first = linear(features, given["from_gaussian.weight"], given["from_gaussian.bias"])
    hidden = (first + given["from_photo.weight"] @ given["vector"]).clamp_min(0)
    hidden = linear(hidden, given["hidden.weight"], given["hidden.bias"]).clamp_min(0)
    shift = linear(hidden, given["output.weight"], given["output.bias"])
    colors = given["colors"].index_copy(0, rows, (base + shift[:, :3]).clamp_min(0))
    if not field.config.opacity_shift:
        return {"colors": colors}
    noise = torch.rand(len(given["means"]), generator=torch.Generator().manual_seed(7))
    noise = torch.logit(noise, eps=1e-6).to(rows.device)[rows]  # as sampled, in float32
    drop = torch.sigmoid((shift[:, 3] + FIRST_LOGIT + noise) / TEMPERATURE)
    before = given["opacities"]
    return {"colors": colors, "opacities": before.index_copy(0, rows, (before[rows] - drop).clamp(0, 1))}
