"""gsplat backend: compositing by gsplat's CUDA kernels."""

from __future__ import annotations

from typing import Any

from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.rendering.gaussians import Gaussians
from lang3dxl_ns.scene.camera import Camera

_STRATEGY_KEYS = ("width", "height", "n_cameras", "radii", "gaussian_ids", "means2d")


def composite_with_gsplat(
    gaussians: Gaussians,
    camera: Camera,
    attached: Float[Tensor, "n c"],
    detached: Float[Tensor, "n d"],
    *,
    depth: bool,
    antialiased: bool,
    absgrad: bool,
    near: float,
    eps2d: float,
) -> tuple[Tensor, Tensor, Tensor, dict[str, Any]]:
    """Composite in float32 what `rasterize` needs: the attached channels (then the depth), the detached ones
    in a second pass, alpha, and the inputs of gsplat's densification."""
    settings = {
        "near_plane": near,
        "eps2d": eps2d,
        "rasterize_mode": "antialiased" if antialiased else "classic",
    }
    mode = "RGB+D" if depth else "RGB"
    maps, alpha, info = _render(gaussians, camera, attached, absgrad=absgrad, render_mode=mode, **settings)
    detached_map = maps[..., :0]
    if detached.shape[1]:
        detached_map, _, _ = _render(gaussians.detach(), camera.detach(), detached, **settings)
    return maps, detached_map, alpha, {key: info[key] for key in _STRATEGY_KEYS}


def _render(
    gaussians: Gaussians, camera: Camera, channels: Float[Tensor, "n c"], **settings: Any
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w 1"], dict[str, Any]]:
    """Call gsplat for one camera."""
    from gsplat import rasterization

    device = gaussians.means.device
    maps, alpha, info = rasterization(
        means=gaussians.means.float(), quats=gaussians.quats.float(), scales=gaussians.scales.float(),
        opacities=gaussians.opacities.float(), colors=channels.float(),
        viewmats=to_device(camera.view_matrix, device).float()[None],
        Ks=to_device(camera.intrinsics, device).float()[None], width=camera.width, height=camera.height,
        packed=False, **settings,
    )  # fmt: skip
    return maps[0], alpha[0], info
