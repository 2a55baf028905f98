"""Random scenes for the rendering tests, and comparison of two rasterizers on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.rendering import Gaussians, Raster
from lang3dxl_ns.scene.camera import Camera


@dataclass
class Cloud:
    """All inputs of a rendering, as named float64 tensors."""

    tensors: dict[str, Tensor]
    intrinsics: Tensor
    width: int
    height: int

    def leaves(self, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
        return {name: value.to(dtype, copy=True).requires_grad_() for name, value in self.tensors.items()}

    def camera(self, leaves: dict[str, Tensor]) -> Camera:
        view = leaves["view_matrix"]
        return Camera(view, self.intrinsics.to(view), self.width, self.height)

    def render(self, rasterizer: Callable[..., Raster], leaves: dict[str, Tensor], **settings: Any) -> Raster:
        """Image over the background, and depth."""
        parts = gaussians(leaves), self.camera(leaves), leaves["channels"], leaves["background"]
        return rasterizer(*parts, **{"render_depth": True, **settings})


def gaussians(leaves: dict[str, Tensor]) -> Gaussians:
    return Gaussians(leaves["means"], leaves["quats"], leaves["scales"], leaves["opacities"])


def make_cloud(count: int, width: int, height: int, *, seed: int = 0, size: float = 0.04) -> Cloud:
    """Anisotropic Gaussians in front of a slightly turned camera; some are behind it or out of view."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    angle = torch.tensor(0.1, dtype=torch.float64)
    view_matrix = torch.eye(4, dtype=torch.float64)
    view_matrix[0, 0] = view_matrix[2, 2] = angle.cos()
    view_matrix[0, 2], view_matrix[2, 0] = angle.sin(), -angle.sin()
    view_matrix[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    tensors = {
        "means": (uniform(count, 3) - 0.5) * torch.tensor([4.0, 3.0, 5.0]) + torch.tensor([0, 0, 2.2]),
        "quats": normal(count, 4),
        "scales": size * torch.exp(0.6 * normal(count, 3)),
        "opacities": torch.sigmoid(2 * normal(count)),
        "channels": torch.cat([uniform(count, 3), normal(count, 2)], dim=1),
        "background": uniform(5),
        "view_matrix": view_matrix,
    }
    intrinsics = torch.tensor(
        [[0.9 * width, 0, 0.52 * width], [0, 0.95 * height, 0.47 * height], [0, 0, 1]], dtype=torch.float64
    )
    return Cloud(tensors, intrinsics, width, height)


def maps(rendering: Raster) -> dict[str, Tensor]:
    found = {name: getattr(rendering, name) for name in ("image", "alpha", "depth")}
    return {name: value for name, value in found.items() if value is not None}


def gradients(
    rendering: Raster, leaves: dict[str, Tensor], *, pixels: Tensor | None = None
) -> dict[str, Tensor]:
    """Gradients for random upstream gradients of every map (in the given pixels [H, W] only)."""
    generator = torch.Generator().manual_seed(0)
    outputs = list(maps(rendering).values())
    if pixels is not None:
        outputs = [out[pixels] for out in outputs]
    upstream = [torch.randn(out.shape, generator=generator, dtype=torch.float64).to(out) for out in outputs]
    found = torch.autograd.grad(outputs, list(leaves.values()), upstream, allow_unused=True)
    return {
        name: torch.zeros_like(leaf) if gradient is None else gradient
        for (name, leaf), gradient in zip(leaves.items(), found, strict=True)
    }


def relative_error(found: Tensor, expected: Tensor) -> float:
    """L2 norm of the difference over that of the expected."""
    expected = expected.double()
    return float((found.double() - expected).norm() / expected.norm().clamp_min(1e-12))
