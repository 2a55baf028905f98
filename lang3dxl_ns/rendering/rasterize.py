"""`rasterize`: differentiable rendering of Gaussians on any device."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

import lang3dxl_ns.rendering.gsplat_build as gsplat_build
from lang3dxl_ns.common.kernels import takes_kernels
from lang3dxl_ns.common.precision import in_full_precision
from lang3dxl_ns.rendering.ellipses import ALPHA_MIN, Ellipses
from lang3dxl_ns.rendering.gaussians import Gaussians, Raster
from lang3dxl_ns.rendering.gsplat_backend import rasterize_with_gsplat
from lang3dxl_ns.rendering.projection import project
from lang3dxl_ns.rendering.torch_rasterizer import Compositing
from lang3dxl_ns.scene.camera import Camera

Backend = Literal["auto", "torch", "numba", "gsplat"]


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
    absgrad: bool = False,
    near: float = 0.01,
    eps2d: float = 0.3,
    backend: Backend = "auto",
) -> Raster:
    """Render Gaussians by alpha compositing (3D Gaussian Splatting, Kerbl et al. 2023; gsplat's rules).

    The result is differentiable in the Gaussians, channels, features, background and the camera's view
    matrix. Gaussians with a NaN or infinite value, also in their channels or features, are not rendered and
    get no gradient, because one would spoil every pixel of its tiles.

    Args:
        gaussians: the Gaussians, world frame.
        camera: where to render them from.
        channels: values to composite over the background, such as activated colors.
        background: one value per channel; black by default.
        features: values composited over black, not divided by alpha.
        detach_features: the features' gradient reaches only `features`, not geometry or opacity.
        render_depth: also render the expected depth, world units.
        antialiased: dim small Gaussians by what the screen-space blur adds to their area.
        absgrad: the backward pass sets `info["means2d"].absgrad` for gsplat's densification.
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
    render: Callable[..., Raster] = functools.partial(_rasterize, backend)
    if backend == "gsplat" and len(channels):
        render = rasterize_with_gsplat
    gaussians, channels, features = _without_broken(gaussians, channels, features)
    camera, place = camera.at_origin(gaussians.means)
    return render(
        gaussians.moved(-place), camera, channels, background,
        features=features, detach_features=detach_features, render_depth=render_depth,
        antialiased=antialiased, absgrad=absgrad, near=near, eps2d=eps2d,
    )  # fmt: skip


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

    return (
        Gaussians(*map(clean, vars(g).values())),
        clean(channels),
        None if features is None else clean(features),
    )


def _kernels(backend: Backend) -> tuple[Callable[..., Ellipses], type[torch.autograd.Function]]:
    """Return the functions that project and composite."""
    if backend == "numba":
        from lang3dxl_ns.rendering.fused_compositing import FusedCompositing
        from lang3dxl_ns.rendering.fused_projection import project as fused_project

        return fused_project, FusedCompositing
    return project, Compositing


def _check_sizes(
    gaussians: Gaussians, channels: Tensor, background: Tensor | None, features: Tensor | None
) -> None:
    count = len(gaussians.means)
    sizes = {name: len(value) for name, value in vars(gaussians).items()} | {"channels": len(channels)}
    if features is not None:
        sizes["features"] = len(features)
    wrong = {name: size for name, size in sizes.items() if size != count}
    if wrong:
        raise ValueError(f"there are {count} means, but {wrong}")
    if background is not None and background.shape != channels.shape[1:]:
        raise ValueError(f"{channels.shape[1]} channels, but a background of shape {tuple(background.shape)}")


def _rasterize(
    backend: Backend,
    gaussians: Gaussians,
    camera: Camera,
    channels: Float[Tensor, "n c"],
    background: Float[Tensor, " c"],
    *,
    features: Float[Tensor, "n d"] | None,
    detach_features: bool,
    render_depth: bool,
    antialiased: bool,
    absgrad: bool,
    near: float,
    eps2d: float,
) -> Raster:
    """Render everything in one pass: depth and features are extra channels of the image."""
    to_screen, compositing = _kernels(backend)
    ellipses = to_screen(gaussians, camera, near=near, eps2d=eps2d, antialiased=antialiased)
    attached = [channels]
    if features is not None and not detach_features:
        attached.append(features)
    if render_depth:
        attached.append(ellipses.depths[:, None])
    maps, detached_map, alpha = compositing.apply(
        ellipses.means2d, ellipses.conics, ellipses.opacities,
        torch.cat(attached, dim=1) if len(attached) > 1 else channels,
        features if features is not None and detach_features else channels[:, :0],
        ellipses.variances, ellipses.depths, camera.width, camera.height, absgrad,
    )  # fmt: skip
    parts = list(maps.split([part.shape[1] for part in attached], dim=2))
    depth = parts.pop() / alpha.clamp_min(ALPHA_MIN / 2) if render_depth else None
    image = parts[0] + (1 - alpha) * background
    feature_map = None
    if features is not None:
        feature_map = detached_map if detach_features else parts[1]
    info = {
        "width": camera.width,
        "height": camera.height,
        "n_cameras": 1,
        "radii": ellipses.radii,
        "gaussian_ids": None,
        "means2d": ellipses.means2d,
    }
    return Raster(image, feature_map, alpha, depth, info)
