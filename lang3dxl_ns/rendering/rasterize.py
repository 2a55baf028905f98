"""`rasterize`: differentiable rendering of Gaussians on any device."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

import lang3dxl_ns.rendering.gsplat_build as gsplat_build
from lang3dxl_ns.common.device import in_full_precision, to_device
from lang3dxl_ns.common.kernels import takes_kernels
from lang3dxl_ns.rendering.gaussians import ALPHA_MIN, Ellipses, Gaussians, Raster
from lang3dxl_ns.rendering.projection import project
from lang3dxl_ns.rendering.torch_rasterizer import Compositing
from lang3dxl_ns.scene.camera import Camera

Backend = Literal["auto", "torch", "numba", "gsplat"]
_STRATEGY_KEYS = ("width", "height", "n_cameras", "radii", "gaussian_ids", "means2d")


@in_full_precision
def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    channels: Float[Tensor, "n c"],
    background: Float[Tensor, " c"] | None = None,
    *,
    features: Float[Tensor, "n d"] | None = None,
    detach_features: bool = True,
    render_depth: bool = False,
    antialiased: bool = False,
    near: float = 0.01,
    eps2d: float = 0.3,
    backend: Backend = "auto",
) -> Raster:
    """Render Gaussians by alpha compositing (3D Gaussian Splatting, Kerbl et al. 2023; gsplat's rules).

    The result is differentiable in the Gaussians, channels, features, background and the camera's view
    matrix. Gaussians with a NaN or infinite value, also in their channels or features, are not rendered and
    get no gradient, because one would spoil every pixel of its tiles.

    Args:
        gaussians, camera: in the world frame.
        channels: values to composite over the background, such as activated colors.
        background: one value per channel; black by default.
        features: values composited over black, not divided by alpha.
        detach_features: the features' gradient reaches only `features`, not geometry or opacity.
        render_depth: also render the expected depth, world units.
        antialiased: dim small Gaussians by what the screen-space blur adds to their area.
        near: Gaussians with centers nearer than this are left out, world units.
        eps2d: variance added on screen, pixels².
        backend: "auto" uses gsplat for tensors on a GPU, or torch if gsplat is not available. On the CPU it
            uses numba if it is installed and the environment variable LANG3DXL_CPU_KERNELS is not torch,
            otherwise torch (which works on any device).

    Raises:
        ValueError: sizes do not match, or the camera has a NaN or infinite value (checked on the CPU only; on
            a GPU the check would force a synchronization).
        UserError: gsplat was requested but is not available.
    """
    _check_sizes(gaussians, channels, background, features)
    parts = camera.view_matrix, camera.intrinsics
    if not all(part.is_cuda or bool(part.isfinite().all()) for part in parts):
        raise ValueError("the camera has a NaN or infinite value: nothing can be rendered from it")
    if background is None:
        background = channels.new_zeros(channels.shape[1])
    if backend == "auto":
        backend = _best_backend(gaussians.means)
    elif backend == "gsplat" and gaussians.means.is_cuda:
        gsplat_build.make_ready()
    # gsplat's kernels cannot be launched on empty input.
    by_gsplat = backend == "gsplat" and len(channels) > 0
    composite = _composite_with_gsplat if by_gsplat else partial(_composite, backend)
    if by_gsplat and not torch.is_grad_enabled():
        detach_features = False  # spares a second pass
    gaussians, channels, features = _without_broken(gaussians, channels, features)
    camera, place = camera.at_origin(gaussians.means)
    attached, detached, sizes = channels, channels[:, :0], [channels.shape[1]]
    if features is not None and detach_features:
        detached = features
    elif features is not None:
        attached = torch.cat([channels, features], dim=1)
        sizes.append(features.shape[1])
    maps, detached_map, alpha, info = composite(
        gaussians.moved(-place), camera, attached, detached,
        depth=render_depth, antialiased=antialiased, near=near, eps2d=eps2d,
    )  # fmt: skip
    image, *others = maps.split([*sizes, 1] if render_depth else sizes, dim=2)
    depth = others.pop() / alpha.clamp_min(ALPHA_MIN / 2) if render_depth else None
    feature_map = None
    if features is not None:
        feature_map = detached_map if detach_features else others[0]
    return Raster(image + (1 - alpha) * background, feature_map, alpha, depth, info)


def _best_backend(means: Tensor) -> Backend:
    if means.is_cuda:
        return "gsplat" if gsplat_build.ready() else "torch"
    return "numba" if takes_kernels(means) else "torch"


def _without_broken(
    gaussians: Gaussians, channels: Float[Tensor, "n c"], features: Float[Tensor, "n d"] | None
) -> tuple[Gaussians, Float[Tensor, "n c"], Float[Tensor, "n d"] | None]:
    """Make Gaussians with a NaN or infinite value transparent and black, without gradient."""
    g = gaussians
    with torch.no_grad():
        total = g.means.sum(1) + g.quats.sum(1) + g.scales.sum(1) + g.opacities + channels.sum(1)
        if features is not None:
            total = total + features.sum(1)
        sound = torch.isfinite(total)
    # On a GPU, checking would force a synchronization, which costs more than cleaning unconditionally.
    if not sound.is_cuda and bool(sound.all()):
        return gaussians, channels, features

    def clean(values: Tensor) -> Tensor:
        return torch.where(sound.view(-1, *[1] * (values.dim() - 1)), values, 0.0)

    features = None if features is None else clean(features)
    return gaussians.mapped(clean), clean(channels), features


def _check_sizes(
    gaussians: Gaussians, channels: Tensor, background: Tensor | None, features: Tensor | None
) -> None:
    count = len(gaussians.means)
    parts = {"channels": channels, "features": features, **vars(gaussians)}
    sizes = {name: len(part) for name, part in parts.items() if isinstance(part, Tensor)}
    wrong = {name: size for name, size in sizes.items() if size != count}
    if wrong:
        raise ValueError(f"there are {count} means, but {wrong}")
    if background is not None and background.shape != channels.shape[1:]:
        raise ValueError(f"{channels.shape[1]} channels, but a background of shape {tuple(background.shape)}")


def _composite(
    backend: Backend,
    gaussians: Gaussians,
    camera: Camera,
    attached: Float[Tensor, "n c"],
    detached: Float[Tensor, "n d"],
    depth: bool,
    antialiased: bool,
    near: float,
    eps2d: float,
) -> tuple[Tensor, Tensor, Tensor, dict[str, Any]]:
    """Composite channels over black: those with a gradient to the geometry (then the depth, if requested),
    those without, and alpha, [h, w, …] each. The last value is `Raster.info`."""
    to_screen: Callable[..., Ellipses] = project
    compositing: type[torch.autograd.Function] = Compositing
    if backend == "numba":
        from lang3dxl_ns.rendering.fused_compositing import FusedCompositing
        from lang3dxl_ns.rendering.fused_projection import project as fused_project

        to_screen, compositing = fused_project, FusedCompositing
    ellipses = to_screen(gaussians, camera, near=near, eps2d=eps2d, antialiased=antialiased)
    maps, detached_map, alpha = compositing.apply(
        ellipses.means2d, ellipses.conics, ellipses.opacities,
        torch.cat([attached, ellipses.depths[:, None]], dim=1) if depth else attached, detached,
        ellipses.variances, ellipses.depths, camera.width, camera.height,
    )  # fmt: skip
    info = {"width": camera.width, "height": camera.height, "n_cameras": 1, "gaussian_ids": None}
    return maps, detached_map, alpha, {**info, "radii": ellipses.radii, "means2d": ellipses.means2d}


def _composite_with_gsplat(
    gaussians: Gaussians,
    camera: Camera,
    attached: Float[Tensor, "n c"],
    detached: Float[Tensor, "n d"],
    depth: bool,
    antialiased: bool,
    near: float,
    eps2d: float,
) -> tuple[Tensor, Tensor, Tensor, dict[str, Any]]:
    """Composite like `_composite` by gsplat's kernels, in float32; detached channels in a second pass."""
    from gsplat import rasterization

    def render(g: Gaussians, camera: Camera, channels: Tensor, mode: str) -> tuple[Tensor, Tensor, dict]:
        device = g.means.device
        maps, alpha, info = rasterization(
            means=g.means.float(), quats=g.quats.float(), scales=g.scales.float(),
            opacities=g.opacities.float(), colors=channels.float(),
            viewmats=to_device(camera.view_matrix, device).float()[None],
            Ks=to_device(camera.intrinsics, device).float()[None], width=camera.width, height=camera.height,
            packed=False, near_plane=near, eps2d=eps2d, render_mode=mode,
            rasterize_mode="antialiased" if antialiased else "classic",
        )  # fmt: skip
        return maps[0], alpha[0], info

    maps, alpha, info = render(gaussians, camera, attached, "RGB+D" if depth else "RGB")
    detached_map = maps[..., :0]
    if detached.shape[1]:
        detached_map, _, _ = render(gaussians.detach(), camera.detach(), detached, "RGB")
    return maps, detached_map, alpha, {key: info[key] for key in _STRATEGY_KEYS}
