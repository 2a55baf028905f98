"""Heat maps of relevancy, and overlays on images."""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.errors import UserError


def heat(
    relevancy: Float[Tensor, "h w"], threshold: float = 0.5, highest: float | None = None
) -> Float[Tensor, "h w"]:
    """Relevancy above the threshold stretched to 0…1; `highest` maps to 1 (None: the map's maximum)."""
    top = float(relevancy.max()) if highest is None else highest
    return ((relevancy - threshold) / max(top - threshold, 1e-6)).clamp(0, 1)


def color(values: Float[Tensor, "*shape"], color_map: str = "turbo") -> Float[Tensor, "*shape 3"]:
    """Values in 0…1 as colors of a matplotlib color map. Raises UserError for an unknown one."""
    table = _colors(color_map).to(values)
    return table[(values.clamp(0, 1) * (len(table) - 1)).round().long()]


def overlay(
    image: Float[Tensor, "h w 3"],
    relevancy: Float[Tensor, "h w"],
    threshold: float = 0.5,
    opacity: float = 0.7,
    color_map: str = "turbo",
    highest: float | None = None,
) -> Float[Tensor, "h w 3"]:
    """The heat map over matching pixels, the image elsewhere."""
    strength = opacity * (relevancy > threshold).to(image)[..., None]
    return torch.lerp(image, color(heat(relevancy, threshold, highest), color_map), strength)


@lru_cache
def _colors(name: str) -> Float[Tensor, "256 3"]:
    from matplotlib import colormaps

    if name not in colormaps:
        raise UserError(
            f"there is no color map {name!r}: choose one of matplotlib's, such as turbo or viridis"
        )
    return torch.tensor(colormaps[name](torch.linspace(0, 1, 256).numpy())[:, :3], dtype=torch.float32)
