"""Hard cases of gathering pixels onto Gaussians, and of relevancy per Gaussian, composited."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from lab.numerics.measure import EXACT, Bounds, Case, Maps, Problem
from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.query.engine import PerGaussian
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.rendering import Gaussians, rasterize
from lang3dxl_ns.rendering.gathering import Pixels, gather
from lang3dxl_ns.scene.camera import Camera

COUNT, CHANNELS, SIZE = 40, 8, 24
BOUNDS = {"float32": Bounds(2e-4, 2e-5), "float64": EXACT}
HALVES = {"float32": Bounds(1e-3, 3e-4), "float64": Bounds(1e-3, 3e-4)}
"""Decoded rows are kept in 16 bits, whatever the rest is in."""


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Opaque and faint Gaussians, masked pixels, features far from zero; widths of CLIP."""
    scenes: dict[str, tuple[Callable[[], Maps], str]] = {
        "usual": (_scene, ""),
        "faint Gaussians": (partial(_scene, opacity=0.02), ""),
        "features of 1e4 beside a spread of 1": (partial(_scene, offset=1e4), ""),
        "half of the pixels masked": (partial(_scene, masked=True), "Gaussians behind the mask: 0"),
    }
    for name, (scene, note) in scenes.items():
        yield Case("gathering", name, partial(_gathering, scene), BOUNDS, note)
    for width in (96, 512, 768, 1152):
        note = "rows of 65 numbers in 16 bits, against all channels"
        yield Case("relevancy per Gaussian", f"{width} channels", partial(_relevancy, width), HALVES, note)


def _scene(opacity: float = 0.6, offset: float = 0.0, masked: bool = False) -> Maps:
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    pixels = torch.cat([offset + uniform(SIZE, SIZE, CHANNELS), torch.ones(SIZE, SIZE, 1).double()], dim=-1)
    if masked:
        pixels[:, : SIZE // 2] = 0
    return {
        "means": uniform(COUNT, 3) - 0.5,
        "quats": uniform(COUNT, 4) - 0.5,
        "scales": 0.03 + 0.1 * uniform(COUNT, 3),
        "opacities": opacity * (0.5 + 0.5 * uniform(COUNT)),
        "pixels": pixels,
    }


def _drawn(given: Maps, features: Tensor) -> Tensor:
    view = torch.eye(4).to(given["means"])
    view[2, 3] = 2.0
    intrinsics = torch.tensor([[26.0, 0.0, SIZE / 2], [0.0, 28.0, SIZE / 2], [0.0, 0.0, 1.0]]).to(view)
    gaussians = Gaussians(given["means"], given["quats"], given["scales"], given["opacities"])
    return rasterize(gaussians, Camera(view, intrinsics, SIZE, SIZE), features).image


def _gathering(scene: Callable[[], Maps]) -> Problem:
    leaves = scene()

    def compute(given: Maps) -> Maps:
        fixed = {name: value.detach() for name, value in given.items()}
        values, foreground = fixed["pixels"][..., :-1], fixed["pixels"][..., -1]
        views = [(partial(_drawn, fixed), Pixels([values], foreground, torch.zeros_like(foreground)))]
        features, mass = gather(COUNT, views, CHANNELS, fixed["means"])
        return {"features": features, "mass": mass}

    def reference(given: Maps) -> Maps:
        weights = _drawn(given, torch.eye(COUNT).to(given["means"]))
        sums = torch.einsum("hwn,hwc->nc", weights, given["pixels"])
        mass = sums[:, -1]
        return {"features": sums[:, :-1] / mass.clamp_min(1e-300)[:, None], "mass": mass}

    return Problem(leaves, compute, reference, constants=frozenset(leaves))


def _relevancy(width: int) -> Problem:
    generator = torch.Generator().manual_seed(0)
    field = CompressedField(SemanticFieldConfig("short"), width)
    for parameter in field.parameters():
        parameter.data.uniform_(-0.5, 0.5, generator=generator)
    field.output_mean.normal_(generator=generator)
    vectors = torch.randn(8, width, generator=generator, dtype=torch.float64)
    leaves = _scene() | {"codes": torch.randn(COUNT, 3, generator=generator, dtype=torch.float64)}
    del leaves["pixels"]

    def queries(like: Tensor) -> Queries:
        return Queries.of([vectors[:1].to(like), vectors[1:3].to(like)], vectors[3:].to(like))

    def compute(given: Maps) -> Maps:
        fixed = {name: value.detach() for name, value in given.items()}
        engine = PerGaussian.of(field.float(), fixed["codes"].float())
        asked = queries(torch.zeros(1))
        carried = engine.channels(asked).to(fixed["means"])
        return {"relevancy": engine.maps(_drawn(fixed, carried), asked)}

    def reference(given: Maps) -> Maps:
        exact = field.double().decode_clip(given["codes"].double()).detach()
        asked = queries(exact)
        scores = asked.relevancy_of_cosines(F.normalize(exact, dim=1) @ asked.vectors.T)
        return {"relevancy": _drawn(given, scores.T.to(given["means"])).permute(2, 0, 1)}

    return Problem(leaves, compute, reference, constants=frozenset(leaves))
