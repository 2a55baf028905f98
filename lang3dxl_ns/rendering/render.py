"""`render`: a pure function that renders a finished scene from a camera."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.rendering.rasterize import Backend, rasterize
from lang3dxl_ns.rendering.splats import Splats
from lang3dxl_ns.scene.camera import Camera


@dataclass(frozen=True, eq=False, repr=False)
class Rendering:
    """Maps of one view, without gradients."""

    camera: Camera
    rgb: Float[Tensor, "h w 3"]
    """Colors over the background, 0…1."""
    alpha: Float[Tensor, "h w"]
    """Accumulated opacity, 0…1."""
    depth: Float[Tensor, "h w"]
    """Expected distance along the camera's axis, world units; 0 where nothing is rendered."""
    channels: Float[Tensor, "h w d"] | None = None
    """Further values of the Gaussians, composited over black and not divided by alpha."""


@torch.no_grad()
def render(
    splats: Splats,
    camera: Camera,
    channels: Float[Tensor, "n d"] | None = None,
    *,
    background: Float[Tensor, "3"] | None = None,
    backend: Backend = "auto",
) -> Rendering:
    """Render Gaussians in their own colors over a background (0…1, by default black), and composite further
    `channels`, one row per Gaussian. This is safe to call from any thread. Raises ValueError like
    `rasterize`."""
    carried = splats.colors(camera.position)
    if channels is not None:
        carried = torch.cat([carried, channels], dim=1)
    behind = carried.new_zeros(carried.shape[1])
    if background is not None:
        behind[:3] = background
    raster = rasterize(
        splats.seen_from(camera), camera, carried, behind,
        render_depth=True, antialiased=splats.antialiased, backend=backend,
    )  # fmt: skip
    assert raster.depth is not None
    colors, others = raster.image[..., :3].clamp(0.0, 1.0), raster.image[..., 3:]
    return Rendering(
        camera, colors, raster.alpha[..., 0], raster.depth[..., 0], None if channels is None else others
    )


def composite(
    splats: Splats, camera: Camera, channels: Float[Tensor, "n d"], backend: Backend = "auto"
) -> Float[Tensor, "h w d"]:
    """Composite values of the Gaussians over black, differentiable in the values, without their colors."""
    seen = splats.seen_from(camera)
    return rasterize(seen, camera, channels, antialiased=splats.antialiased, backend=backend).image
