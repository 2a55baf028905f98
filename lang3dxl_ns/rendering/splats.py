"""`Splats`, the Gaussians of a finished scene as an immutable value, and their renderings from a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isqrt

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.rendering.gaussians import Gaussians
from lang3dxl_ns.rendering.rasterize import Backend, rasterize
from lang3dxl_ns.rendering.spherical_harmonics import BAND_0, spherical_harmonics
from lang3dxl_ns.scene.camera import Camera


@dataclass(frozen=True, eq=False, repr=False)
class Splats(Gaussians):
    """Gaussians with colors, without gradients. All tensors are on one device. They must not be written to:
    renderings in other threads may be reading them."""

    harmonics: Float[Tensor, "n k 3"]
    """Spherical harmonics of the colors, degrees 0 to 3, the constant ones first (k = 1, 4, 9 or 16)."""
    antialiased: bool = False
    """Whether small Gaussians are dimmed by what the screen-space blur adds to their area, as in training."""
    backend: Backend = "auto"
    """The rasterizer that draws them, see `rasterize`."""

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"Splats({len(self):,} Gaussians, harmonics of degree {self.degree}, on {self.means.device})"

    @property
    def degree(self) -> int:
        """Degree of the harmonics; 0 for colors that do not depend on the viewing direction."""
        return isqrt(self.harmonics.shape[1]) - 1

    @property
    def gaussians(self) -> Gaussians:
        """Shapes of the Gaussians, without their colors."""
        return Gaussians(self.means, self.quats, self.scales, self.opacities)

    def colors(self, center: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        """Compute red, green and blue, 0 and above, as seen from a point in the world frame."""
        directions = self.means - to_device(center.to(self.means.dtype), self.means.device)
        return (spherical_harmonics(self.degree, directions, self.harmonics) + 0.5).clamp_min(0.0)

    def to(self, device: torch.device | str) -> Splats:
        """Return the same Gaussians on a device."""
        return self.mapped(lambda tensor: tensor.to(device))

    def select(self, which: Bool[Tensor, " n"] | Int[Tensor, " m"]) -> Splats:
        """Return some of the Gaussians, chosen by a mask or by their indices (tensors or NumPy arrays)."""
        rows = torch.as_tensor(which, device=self.means.device)
        return self.mapped(lambda tensor: tensor[rows])

    def thinned(self, most: int) -> Splats:
        """Return at most this many of the Gaussians, evenly spaced, enlarged so that they cover as much."""
        every = -(-len(self) // most)
        some = self.select(torch.arange(0, len(self), every))
        return replace(some, scales=some.scales * every**0.5)

    def sound(self) -> Bool[Tensor, " n"]:
        """Return which Gaussians have no NaN or infinite value."""
        parts = (self.means, self.quats, self.scales, self.opacities, self.harmonics)
        return torch.stack([part.reshape(len(self), -1).isfinite().all(1) for part in parts]).all(0)


def harmonics_of(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Compute harmonics of degree 0 for colors that do not depend on the viewing direction."""
    return (colors[:, None] - 0.5) / BAND_0


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
        splats.gaussians.seen_from(camera), camera, carried, behind,
        render_depth=True, antialiased=splats.antialiased, backend=splats.backend,
    )  # fmt: skip
    assert raster.depth is not None
    colors, others = raster.image[..., :3].clamp(0.0, 1.0), raster.image[..., 3:]
    return Rendering(
        camera, colors, raster.alpha[..., 0], raster.depth[..., 0], None if channels is None else others
    )


def composite(splats: Splats, camera: Camera, channels: Float[Tensor, "n d"]) -> Float[Tensor, "h w d"]:
    """Composite values of the Gaussians over black, differentiable in the values, without their colors."""
    seen = splats.gaussians.seen_from(camera)
    return rasterize(seen, camera, channels, antialiased=splats.antialiased, backend=splats.backend).image
