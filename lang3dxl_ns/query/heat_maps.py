"""Heat maps of relevancy, and overlays on images."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from numpy import ndarray as Array
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from lang3dxl_ns.common.errors import UserError

_OPACITY = 0.7
"""Share of the heat in the color of a pixel that matches."""


def heat(relevancy: Float[Tensor, "h w"], threshold: float = 0.5) -> Float[Tensor, "h w"]:
    """Relevancy above the threshold stretched to 0…1, which the map's highest is."""
    return ((relevancy - threshold) / max(float(relevancy.max()) - threshold, 1e-6)).clamp(0, 1)


def color(values: Float[Tensor, "*shape"], color_map: str = "turbo") -> Float[Tensor, "*shape 3"]:
    """Values in 0…1 as colors of a matplotlib color map. Raises UserError for an unknown one."""
    table = _colors(color_map).to(values)
    return table[(values.clamp(0, 1) * (len(table) - 1)).round().long()]


def overlay(
    image: Float[Tensor, "h w 3"],
    relevancy: Float[Tensor, "h w"],
    mask: Bool[Tensor, "h w"],
    threshold: float = 0.5,
    opacity: float = _OPACITY,
    color_map: str = "turbo",
) -> Float[Tensor, "h w 3"]:
    """The heat map over matching pixels, the image elsewhere.

    Args:
        image: colors, 0…1.
        relevancy: 0…1.
        mask: pixels that match.
        threshold: relevancy of the color map's first color; the highest gets its last.
        opacity: of the heat map, 0…1.
        color_map: name of a matplotlib color map.

    Raises:
        UserError: there is no such color map.
    """
    hot = color(heat(relevancy * mask, threshold), color_map)
    return torch.lerp(image, hot, opacity * mask.to(image)[..., None])


@lru_cache
def _colors(name: str) -> Float[Tensor, "256 3"]:
    from matplotlib import colormaps

    if name not in colormaps:
        raise UserError(
            f"there is no color map {name!r}: choose one of matplotlib's, such as turbo or viridis"
        )
    return torch.tensor(colormaps[name](torch.linspace(0, 1, 256).numpy())[:, :3], dtype=torch.float32)


def strongest(
    maps: Float[Tensor, "q ..."], masks: Bool[Tensor, "q ..."]
) -> tuple[Float[Tensor, "..."], Int64[Tensor, "..."]]:
    """The highest relevancy of the prompts that match a place, 0 where none does; and which prompt that
    is."""
    best, which = torch.where(masks, maps, -1.0).max(0)
    return best.clamp_min(0), which


PROMPT_COLORS = (
    *((230, 25, 75), (0, 130, 200), (245, 130, 48), (60, 180, 75), (145, 30, 180)),
    *((70, 240, 240), (240, 50, 230), (210, 245, 60), (170, 110, 40), (128, 0, 0)),
)
"""Distinct colors, one per prompt; they repeat after the tenth."""
_FONT_SHARE = 32
"""Height of a legend's letters: the picture's width divided by this, at least 11 pixels."""


def tinted(
    image: Float[Tensor, "h w 3"],
    maps: Float[Tensor, "q h w"],
    masks: Bool[Tensor, "q h w"],
    threshold: float,
) -> Float[Tensor, "h w 3"]:
    """The image with each prompt's matches in its own color: that of the most relevant where several match,
    stronger with relevancy above the threshold."""
    best, which = strongest(maps, masks)
    colors = torch.tensor([PROMPT_COLORS[i % len(PROMPT_COLORS)] for i in range(len(maps))]).to(image) / 255
    strength = _OPACITY * masks.any(0) * (0.5 + 0.5 * heat(best, threshold))
    return torch.lerp(image, colors[which], strength[..., None].to(image))


def with_legend(
    picture: UInt8[Array, "h w 3"], labels: Sequence[str], colors: Sequence[tuple[int, int, int]]
) -> UInt8[Array, "h+legend w 3"]:
    """A picture with a line below for each label: a square of its color, and the words."""
    height, width = picture.shape[:2]
    size = max(width // _FONT_SHARE, 11)
    line = size + size // 2
    canvas = Image.new("RGB", (width, height + line * len(labels)), "white")
    canvas.paste(Image.fromarray(picture))
    pen, font = ImageDraw.Draw(canvas), ImageFont.load_default(size)
    for i, label in enumerate(labels):
        top = height + i * line + (line - size) // 2
        pen.rectangle((size // 2, top, size // 2 + size, top + size), fill=colors[i % len(colors)])
        pen.text((2 * size, top + size / 2), " ".join(label.split()), "black", font, anchor="lm")
    return np.asarray(canvas)
