"""`rasterize`: the one way from Gaussians to pixels, whatever the device."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.precision import in_full_precision
from lang3dxl_ns.rendering.compositing import composite
from lang3dxl_ns.rendering.gaussians import Camera, Gaussians, Rendering
from lang3dxl_ns.rendering.gsplat_backend import rasterize_with_gsplat
from lang3dxl_ns.rendering.projection import project
from lang3dxl_ns.rendering.tile_plan import ALPHA_MIN

Backend = Literal["auto", "torch", "gsplat"]


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
) -> Rendering:
    """Render Gaussians by alpha compositing (3D Gaussian Splatting, Kerbl et al. 2023; rules of gsplat).

    Differentiable in the Gaussians, channels, features, background and the camera's view matrix.

    Args:
        channels: what to composite over the background, such as colours after activation.
        background: one value per channel; black by default.
        features: composited in the same way over black, not divided by alpha.
        detach_features: the features' gradient reaches only `features`, not geometry or opacity.
        render_depth: also make the expected depth, world units.
        antialiased: dim small Gaussians by what the screen-space blur adds to their area.
        absgrad: the backward fills `info["means2d"].absgrad` for gsplat's densification.
        near: Gaussians whose centres are nearer than this are left out, world units.
        eps2d: variance added on the screen, pixels².
        backend: "auto" takes gsplat for tensors on a GPU, else torch (which works on any device).

    Gaussians with a NaN or infinite value are not rendered and get no gradient.

    Raises:
        ValueError: sizes that don't fit together.
    """
    _check_sizes(gaussians, channels, background, features)
    if background is None:
        background = channels.new_zeros(channels.shape[1])
    if backend == "auto":
        backend = "gsplat" if gaussians.means.is_cuda else "torch"
    # gsplat's kernels can't be launched over nothing.
    render = rasterize_with_gsplat if backend == "gsplat" and len(channels) else _rasterize_with_torch
    camera, place = camera.at_origin(gaussians.means)
    return render(
        gaussians.without_broken().moved(-place), camera, channels, background,
        features=features, detach_features=detach_features, render_depth=render_depth,
        antialiased=antialiased, absgrad=absgrad, near=near, eps2d=eps2d,
    )  # fmt: skip


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


def _rasterize_with_torch(
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
) -> Rendering:
    """One pass for everything: depth and features are further channels of the image."""
    splats = project(gaussians, camera, near=near, eps2d=eps2d, antialiased=antialiased)
    attached = [channels]
    if features is not None and not detach_features:
        attached.append(features)
    if render_depth:
        attached.append(splats.depths[:, None])
    maps, detached_map, alpha = composite(
        splats.means2d, splats.conics, splats.variances, splats.depths, splats.opacities,
        torch.cat(attached, dim=1) if len(attached) > 1 else channels, camera.width, camera.height,
        detached_channels=features if detach_features else None, absgrad=absgrad,
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
        "radii": splats.radii,
        "gaussian_ids": None,
        "means2d": splats.means2d,
    }
    return Rendering(image, feature_map, alpha, depth, info)
