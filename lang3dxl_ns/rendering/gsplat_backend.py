"""gsplat backend: CUDA kernels behind the signature of `rasterize`."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.rendering.gaussians import Gaussians, Raster
from lang3dxl_ns.scene.camera import Camera

_STRATEGY_KEYS = ("width", "height", "n_cameras", "radii", "gaussian_ids", "means2d")


def rasterize_with_gsplat(
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
    """Render as `rasterize` does, in float32. Detached features cost a second pass if there is a gradient."""
    detach_features &= torch.is_grad_enabled()
    settings = {
        "near_plane": near,
        "eps2d": eps2d,
        "rasterize_mode": "antialiased" if antialiased else "classic",
    }
    count = channels.shape[1]
    if features is not None and not detach_features:
        channels = torch.cat([channels, features], dim=1)
        background = torch.cat([background, background.new_zeros(features.shape[1])])
    maps, alpha, info = _render(
        gaussians, camera, channels, background, absgrad=absgrad,
        render_mode="RGB+ED" if render_depth else "RGB", **settings,
    )  # fmt: skip
    image, feature_map = maps[..., :count], None
    if features is not None and not detach_features:
        feature_map = maps[..., count : channels.shape[1]]
    elif features is not None:
        black = background.new_zeros(features.shape[1])
        feature_map, _, _ = _render(gaussians.detach(), camera.detach(), features, black, **settings)
    return Raster(
        image=image, features=feature_map, alpha=alpha, depth=maps[..., -1:] if render_depth else None,
        info={key: info[key] for key in _STRATEGY_KEYS},
    )  # fmt: skip


def _render(
    gaussians: Gaussians,
    camera: Camera,
    channels: Float[Tensor, "n c"],
    background: Float[Tensor, " c"],
    **settings: Any,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w 1"], dict[str, Any]]:
    """Call gsplat for one camera."""
    from gsplat import rasterization

    device = gaussians.means.device
    maps, alpha, info = rasterization(
        means=gaussians.means.float(), quats=gaussians.quats.float(), scales=gaussians.scales.float(),
        opacities=gaussians.opacities.float(), colors=channels.float(),
        viewmats=to_device(camera.view_matrix, device).float()[None],
        Ks=to_device(camera.intrinsics, device).float()[None], width=camera.width, height=camera.height,
        backgrounds=background.float()[None], packed=False, **settings,
    )  # fmt: skip
    return maps[0], alpha[0], info
