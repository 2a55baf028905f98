"""`rasterize`: differentiable rendering of Gaussians on any device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.device import in_full_precision, to_device
from lang3dxl_ns.common.kernels import takes_kernels
from lang3dxl_ns.rendering.gaussians import ALPHA_MIN, Ellipses, Gaussians, Raster
from lang3dxl_ns.rendering.projection import project
from lang3dxl_ns.rendering.torch_rasterizer import Compositing
from lang3dxl_ns.scene.camera import Camera, at_size

Backend = Literal["auto", "torch", "numba", "gsplat"]
EPS2D = 0.3
"""Variance that blurs Gaussians on screen, pixels² (gsplat's default)."""
_STRATEGY_KEYS = ("width", "height", "n_cameras", "radii", "gaussian_ids", "means2d")


@in_full_precision
def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    channels: Float[Tensor, "n c"],
    background: Float[Tensor, " c"] | None = None,
    *,
    render_depth: bool = False,
    antialiased: bool = False,
    near: float = 0.01,
    eps2d: float = EPS2D,
    backend: Backend = "auto",
) -> Raster:
    """Render Gaussians by alpha compositing (3D Gaussian Splatting, Kerbl et al. 2023; gsplat's rules).

    The result is differentiable in the Gaussians, channels, background and the camera's view matrix.
    Gaussians with a NaN or infinite value, also in their channels, are not rendered and get no gradient,
    because one would spoil every pixel of its tiles.

    Args:
        gaussians, camera: in the world frame.
        channels: values to composite over the background, such as activated colors.
        background: one value per channel; black by default.
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
    _check_sizes(gaussians, channels, background)
    parts = camera.view_matrix, camera.intrinsics
    if not all(part.is_cuda or bool(part.isfinite().all()) for part in parts):
        raise ValueError("the camera has a NaN or infinite value: nothing can be rendered from it")
    if background is None:
        background = channels.new_zeros(channels.shape[1])
    if backend == "auto":
        backend = _best_backend(gaussians.means)
    elif backend == "gsplat" and gaussians.means.is_cuda:
        import lang3dxl_ns.rendering.gsplat_build as gsplat_build

        gsplat_build.make_ready()
    # gsplat's kernels cannot be launched on empty input.
    by_gsplat = backend == "gsplat" and len(channels) > 0
    composite = _composite_with_gsplat if by_gsplat else partial(_composite, backend)
    gaussians, channels = _without_broken(gaussians, channels)
    camera, place = camera.at_origin(gaussians.means)
    maps, alpha, info = composite(
        replace(gaussians, means=gaussians.means - place), camera, channels,
        depth=render_depth, antialiased=antialiased, near=near, eps2d=eps2d,
    )  # fmt: skip
    depth = maps[..., -1:] / alpha.clamp_min(ALPHA_MIN / 2) if render_depth else None
    image = maps[..., : channels.shape[1]] + (1 - alpha) * background
    return Raster(image, alpha, depth, info)


def at_fewer_pixels(camera: Camera, height: int, width: int) -> tuple[Camera, float]:
    """Return the view at a smaller size, and the `eps2d` with which the same ellipses are drawn there."""
    return at_size(camera, height, width), EPS2D * height * width / (camera.height * camera.width)


def _best_backend(means: Tensor) -> Backend:
    if means.is_cuda:
        import lang3dxl_ns.rendering.gsplat_build as gsplat_build

        return "gsplat" if gsplat_build.ready() else "torch"
    return "numba" if takes_kernels(means) else "torch"


def _without_broken(
    gaussians: Gaussians, channels: Float[Tensor, "n c"]
) -> tuple[Gaussians, Float[Tensor, "n c"]]:
    """Make Gaussians with a NaN or infinite value transparent and black, without gradient."""
    g = gaussians
    with torch.no_grad():
        total = g.means.sum(1) + g.quats.sum(1) + g.scales.sum(1) + g.opacities + channels.sum(1)
        sound = torch.isfinite(total)
    # On a GPU, checking would force a synchronization, which costs more than cleaning unconditionally.
    if not sound.is_cuda and bool(sound.all()):
        return gaussians, channels

    def clean(values: Tensor) -> Tensor:
        return torch.where(sound.view(-1, *[1] * (values.dim() - 1)), values, 0.0)

    return gaussians.mapped(clean), clean(channels)


def _check_sizes(gaussians: Gaussians, channels: Tensor, background: Tensor | None) -> None:
    count = len(gaussians.means)
    parts = {"channels": channels, **vars(gaussians)}
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
    channels: Float[Tensor, "n c"],
    depth: bool,
    antialiased: bool,
    near: float,
    eps2d: float,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Composite channels (then the depth, if requested) over black, and alpha, [h, w, …] each. The last value
    is `Raster.info`."""
    to_screen: Callable[..., Ellipses] = project
    compositing: type[torch.autograd.Function] = Compositing
    if backend == "numba":
        from lang3dxl_ns.rendering.fused_compositing import FusedCompositing
        from lang3dxl_ns.rendering.fused_projection import project as fused_project

        to_screen, compositing = fused_project, FusedCompositing
    ellipses = to_screen(gaussians, camera, near=near, eps2d=eps2d, antialiased=antialiased)
    maps, alpha = compositing.apply(
        ellipses.means2d, ellipses.conics, ellipses.opacities,
        torch.cat([channels, ellipses.depths[:, None]], dim=1) if depth else channels,
        ellipses.variances, ellipses.depths, camera.width, camera.height,
    )  # fmt: skip
    info = {"width": camera.width, "height": camera.height, "n_cameras": 1, "gaussian_ids": None}
    return maps, alpha, {**info, "radii": ellipses.radii, "means2d": ellipses.means2d}


def _composite_with_gsplat(
    gaussians: Gaussians,
    camera: Camera,
    channels: Float[Tensor, "n c"],
    depth: bool,
    antialiased: bool,
    near: float,
    eps2d: float,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Composite like `_composite` by gsplat's kernels, in float32."""
    from gsplat import rasterization

    device, quats = gaussians.means.device, gaussians.quats.float()
    still = (quats == 0).all(1, keepdim=True)  # no rotation, of which gsplat makes NaN
    quats = torch.cat([quats[:, :1] + still, quats[:, 1:]], dim=1)
    maps, alpha, info = rasterization(
        means=gaussians.means.float(), quats=quats, scales=gaussians.scales.float(),
        opacities=gaussians.opacities.float(), colors=channels.float(),
        viewmats=to_device(camera.view_matrix, device).float()[None],
        Ks=to_device(camera.intrinsics, device).float()[None], width=camera.width, height=camera.height,
        packed=False, near_plane=near, eps2d=eps2d, render_mode="RGB+D" if depth else "RGB",
        rasterize_mode="antialiased" if antialiased else "classic",
    )  # fmt: skip
    return maps[0], alpha[0], {key: info[key] for key in _STRATEGY_KEYS}
