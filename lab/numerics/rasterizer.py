"""Hard cases of the rasterizer: extreme Gaussians and cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial

import torch
from torch import Tensor

from lab.numerics.measure import Bounds, Case, Maps, Problem
from lab.numerics.rasterizer_reference import rasterize_reference
from lang3dxl_ns.common.kernels import numba_works
from lang3dxl_ns.rendering import Backend, Gaussians, rasterize
from lang3dxl_ns.rendering.gaussians import MAX_LOG_SCALE
from lang3dxl_ns.scene.camera import Camera

NEAR = 0.01
MODES = {"float32": Bounds(8e-3, 3e-4, 1e-3, 1e-3, flipped=0.02), "float64": Bounds(1e-8, 1e-8, 1e-6, 1e-6)}
"""Bounds: one pair that flips across 1/255 changes a pixel by up to 1/255; the stop at 1e-4 adds a little."""
GSPLAT = {"float32": Bounds(0.1, 1e-2, 0.5, 0.1, flipped=1.0)}
"""Bounds of gsplat, which cuts a Gaussian at three standard deviations, where alpha may still be 0.011."""


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Yield all cases for the torch backend, the compiled kernels (on the CPU) and gsplat (on a GPU)."""
    yield from _cases("rasterizer, torch", "torch", MODES, quick)
    if device == "cpu" and numba_works():
        yield from _cases("rasterizer, numba", "numba", MODES, quick)
    if device == "cuda":
        yield from _cases("rasterizer, gsplat", "gsplat", GSPLAT, quick)


def _cases(component: str, backend: Backend, modes: Mapping[str, Bounds], quick: bool) -> Iterator[Case]:
    for name, scene in _catalog(quick).items():
        yield Case(component, name, partial(_problem, scene, backend), modes, scene().note)
    single = modes["float32"]
    note = "autocast is off inside: positions don't survive 16 bits"
    mixed = {"bf16": single, "fp16": single}
    yield Case(component, "mixed precision", partial(_problem, Scene, backend), mixed, note)


class Scene:
    """Named float64 tensors and a camera. The methods change the scene and return it."""

    def __init__(self, count: int = 300, width: int = 48, height: int = 36, seed: int = 0):
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        self.width, self.height, self.near = width, height, NEAR
        self.focal = (0.9 * width, 0.9 * width)
        self.center = (0.52 * width, 0.47 * height)
        self.outputs: tuple[str, ...] = ("image", "alpha", "depth")
        self.constants: frozenset[str] = frozenset()
        self.note = ""
        depth = 2 + 3 * torch.rand(count, generator=generator, dtype=torch.float64)
        across = 0.6 * normal(count, 2) * depth[:, None] * torch.tensor([1, height / width])
        self.leaves: Maps = {
            "means": torch.cat([across, depth[:, None]], dim=1),
            "quats": normal(count, 4),
            "log_scales": math.log(0.08) + 0.6 * normal(count, 3),
            "logits": 2 * normal(count),
            "channels": torch.rand(count, 3, generator=generator, dtype=torch.float64),
            "background": torch.rand(3, generator=generator, dtype=torch.float64),
            "view_matrix": torch.eye(4, dtype=torch.float64),
        }

    def set(self, first: int | None = None, **values: object) -> Scene:
        """Give the first Gaussians (default: all) these values."""
        for name, value in values.items():
            self.leaves[name][:first] = torch.as_tensor(value, dtype=torch.float64)
        return self

    def seen_with(self, focal: tuple[float, float], center: tuple[float, float] | None = None) -> Scene:
        """Change the lens, and spread the Gaussians over its field of view."""
        spread = torch.tensor([self.focal[0] / focal[0], self.focal[1] / focal[1], 1.0])
        center = center or self.center
        self.leaves["means"] *= spread
        for axis in (0, 1):
            slope = (self.center[axis] - center[axis]) / focal[axis]
            self.leaves["means"][:, axis] += slope * self.leaves["means"][:, 2]
        self.leaves["log_scales"] += math.log(min(spread[0], spread[1]))
        self.focal, self.center = focal, center
        return self

    def in_world(self, scale: float = 1.0, offset: float = 0.0) -> Scene:
        """Rotate, scale (the near plane too) and move the world frame; the image stays the same."""
        rotation = _rotation(torch.tensor([0.4, -0.7, 0.2], dtype=torch.float64))
        origin = offset * torch.tensor([0.48, 4.6, 0.1], dtype=torch.float64)  # eastings, northings, height
        self.leaves["means"] = scale * self.leaves["means"] @ rotation + origin
        turn = _quaternion(torch.tensor([-0.4, 0.7, -0.2], dtype=torch.float64))
        self.leaves["quats"] = _multiply(turn, self.leaves["quats"])
        self.leaves["log_scales"] += math.log(scale)
        self.leaves["view_matrix"][:3, :3] = rotation
        self.leaves["view_matrix"][:3, 3] = -rotation @ origin
        self.near *= scale
        return self

    def opaque(self) -> Scene:
        """Exclude the gradient of the background."""
        self.constants = frozenset({"background"})
        self.note = "without the background's gradient, which is 1 − alpha: at an alpha near 1, its rounding"
        return self


def _catalog(quick: bool) -> dict[str, Callable[[], Scene]]:
    """Return functions that build the scenes, by name."""
    many = 4_000 if quick else 20_000
    stack = 10_000 if quick else 100_000
    return {
        "usual scene": Scene,
        "no Gaussian": lambda: Scene(0),
        "one Gaussian": lambda: Scene(1).set(means=[0.0, 0, 3], logits=3.0),
        "none visible": lambda: Scene(50).set(means=[0.0, 0, -3]),
        "needles, aspect 1e6": lambda: Scene().set(log_scales=_logs(0.5, 5e-7, 5e-7)),
        "discs, aspect 1e6": lambda: Scene().set(log_scales=_logs(0.5, 0.5, 5e-7)),
        "scales 1e-8 to 1e5": _scales_of_every_size,
        "opacity logits ±50": lambda: Scene().set(logits=-50.0).set(60, logits=50.0),
        "quaternions zero and NaN": lambda: Scene().set(20, quats=math.nan).set(10, quats=0.0),
        "every value NaN or infinite somewhere": _broken_values,
        "equal depths": lambda: _at_depth(Scene(1000), 3.0),
        "at, behind and beside the near plane": _near_plane,
        "one Gaussian covers the image": lambda: Scene().set(1, means=[0.0, 0, 1], log_scales=7.0),
        f"{many:,} overlapping, opacity 0.99": lambda: _pile(many, 0.99),
        f"{stack:,} transparent": lambda: _pile(stack, 0.005),
        "field of view 0.5°": lambda: Scene().seen_with(_focal(0.5)),
        "field of view 150°": lambda: Scene().seen_with(_focal(150)),
        "fx = 10 fy": lambda: Scene().seen_with((430.0, 43.0)),
        "principal point outside": lambda: Scene().seen_with((43.0, 43.0), (-80.0, 90.0)),
        "image 1×1": lambda: Scene(100, 1, 1).seen_with((30.0, 30.0)).opaque(),
        "image 1×4000": lambda: Scene(200, 1, 4000).seen_with((30.0, 3000.0)),
        "image 4000×1": lambda: Scene(200, 4000, 1).seen_with((3000.0, 30.0)),
        "world 1e-3 wide": lambda: Scene().in_world(1e-3),
        "world 1e5 wide": lambda: Scene().in_world(1e5),
        "world offset 1e6 (UTM)": lambda: Scene().in_world(offset=1e6),
        "thousands at one depth, up to rounding": _rounded_depths,
    }


def _focal(degrees: float, width: int = 48) -> tuple[float, float]:
    """Compute the focal lengths in pixels for a field of view across the width."""
    focal = width / (2 * math.tan(math.radians(degrees) / 2))
    return focal, focal


def _logs(*scales: float) -> Tensor:
    return torch.tensor(scales, dtype=torch.float64).log()


def _scales_of_every_size() -> Scene:
    scene = Scene()
    spread = torch.linspace(math.log(1e-8), math.log(1e5), 900, dtype=torch.float64)
    order = torch.randperm(900, generator=torch.Generator().manual_seed(1))
    # They are mostly transparent, or the large ones would hide everything else.
    return scene.set(log_scales=spread[order].view(300, 3), logits=scene.leaves["logits"] - 3).opaque()


def _broken_values() -> Scene:
    scene = Scene()
    scene.leaves["log_scales"][0], scene.leaves["logits"][1] = math.inf, -math.inf
    for row, value in enumerate((math.nan, math.inf, -math.inf)):
        scene.leaves["means"][2 + row], scene.leaves["quats"][5 + row] = value, value
    return scene


def _at_depth(scene: Scene, depth: float) -> Scene:
    scene.leaves["means"][:, 2] = depth
    return scene


def _rounded_depths() -> Scene:
    scene = _at_depth(Scene(4000).set(logits=-4.0), 3.0).in_world(offset=1.0)
    scene.outputs = ("alpha",)
    scene.note = "their order is decided by rounding, so colors may differ; alpha may not"
    return scene


def _near_plane() -> Scene:
    scene = Scene()
    depths = [-1, -1e-3, 0, 1e-6, 0.5 * NEAR, NEAR, 1.001 * NEAR, 2 * NEAR, 0.1]
    for row, depth in enumerate(depths):
        scene.leaves["means"][row] = torch.tensor([0.3 * depth, 0.2 * depth, depth])
        scene.leaves["log_scales"][row] = math.log(max(abs(depth), 1e-4) / 10)
    beside = torch.tensor([5.0, -3.0, 1.01 * NEAR])  # hundreds of image widths to the side
    scene.leaves["means"][len(depths)] = beside
    return scene


def _pile(count: int, opacity: float) -> Scene:
    """Build Gaussians on top of each other over a few pixels."""
    scene = Scene(count, 8, 6)
    scene.leaves["means"][:, :2] *= 0.2
    scene.leaves["log_scales"] += math.log(2.0 / 0.08)
    return scene.set(logits=math.log(opacity / (1 - opacity))).opaque()


def _problem(scene: Callable[[], Scene], backend: Backend) -> Problem:
    made = scene()
    width, height = made.width, made.height

    def camera(leaves: Maps) -> Camera:
        (fx, fy), (cx, cy) = made.focal, made.center
        intrinsics = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float32)
        return Camera(leaves["view_matrix"], intrinsics.to(leaves["view_matrix"]), width, height)

    def compute(leaves: Maps) -> Maps:
        rendering = rasterize(
            _gaussians(leaves), camera(leaves), leaves["channels"], leaves["background"],
            render_depth=True, near=made.near, backend=backend,
        )  # fmt: skip
        return {name: getattr(rendering, name) for name in made.outputs}

    def reference(leaves: Maps) -> Maps:
        seen = _seen(leaves, made.near)
        gaussians, channels = _gaussians({**leaves, **seen}), seen["channels"]
        rendering = rasterize_reference(
            gaussians, camera(leaves), channels, leaves["background"], render_depth=True, near=made.near
        )
        return {name: getattr(rendering, name) for name in made.outputs}

    return Problem(made.leaves, compute, reference, thresholds=True, constants=made.constants)


def _gaussians(leaves: Maps) -> Gaussians:
    """Build the Gaussians, activated as in the model."""
    scales = leaves["log_scales"].clamp_max(MAX_LOG_SCALE).exp()
    return Gaussians(leaves["means"], leaves["quats"], scales, leaves["logits"].sigmoid())


def _seen(leaves: Maps, near: float) -> Maps:
    """Select the finite Gaussians beyond the near plane, with the identity in place of a zero quaternion."""
    properties = ("means", "quats", "log_scales", "logits", "channels")
    with torch.no_grad():
        depths = leaves["means"] @ leaves["view_matrix"][2, :3] + leaves["view_matrix"][2, 3]
        sound = depths.isfinite() & leaves["quats"].sum(1).isfinite()
        kept = sound & (leaves["log_scales"].sum(1) < math.inf) & (depths > near)
    seen = {name: leaves[name][kept] for name in properties}
    none = (seen["quats"] == 0).all(1, keepdim=True)
    seen["quats"] = torch.where(none, seen["quats"].new_tensor([1.0, 0, 0, 0]), seen["quats"])
    return seen


def _quaternion(vector: Tensor) -> Tensor:
    """Compute the quaternion of a rotation vector."""
    angle = vector.norm()
    return torch.cat([(angle / 2).cos()[None], (angle / 2).sin() * vector / angle])


def _rotation(vector: Tensor) -> Tensor:
    x, y, z = vector.tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(cross)


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    """Multiply one quaternion with many."""
    w, v = b[:, :1], b[:, 1:]
    cross = torch.linalg.cross(a[1:].expand_as(v), v)
    return torch.cat([a[0] * w - v @ a[1:, None], a[0] * v + w * a[1:] + cross], dim=1)
