"""Heat maps of relevancy, and overlays on images."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from numpy import ndarray as Array
from PIL import Image, ImageDraw
from torch import Tensor

from lang3dxl_ns.common.captions import letters, lines

_OPACITY = 0.7
"""Opacity of the heat over a pixel that matches."""


def heat(relevancy: Float[Tensor, "h w"], threshold: float = 0.5) -> Float[Tensor, "h w"]:
    """Stretch relevancies to 0…1, from the threshold to the map's maximum."""
    return ((relevancy - threshold) / max(float(relevancy.max()) - threshold, 1e-6)).clamp(0, 1)


def color(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape 3"]:
    """Map values in 0…1 to colors of the table turbo."""
    table = _colors().to(values)
    return table[(values.clamp(0, 1) * (len(table) - 1)).round().long()]


def overlay(
    image: Float[Tensor, "h w 3"], relevancy: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"], level: float
) -> Float[Tensor, "h w 3"]:
    """Draw the heat map over the pixels that match, and keep the image (colors 0…1) elsewhere. A relevancy of
    `level` gets the first color, and the highest relevancy the last."""
    hot = color(heat(relevancy * mask, level))
    return torch.lerp(image, hot, _OPACITY * mask.to(image)[..., None])


@lru_cache
def _colors() -> Float[Tensor, "256 3"]:
    """Load the 256 colors of turbo (Mikhailov 2019)."""
    return torch.from_numpy(np.array(Image.open(Path(__file__).with_suffix(".png")))[0]) / 255


def strongest(
    maps: Float[Tensor, "q ..."], masks: Bool[Tensor, "q ..."]
) -> tuple[Float[Tensor, "..."], Int64[Tensor, "..."]]:
    """Return the highest relevancy of the prompts that match a place (0 for none), and its prompt's index."""
    best, which = torch.where(masks, maps, -1.0).max(0)
    return best.clamp_min(0), which


PROMPT_COLORS = (
    *((230, 25, 75), (0, 130, 200), (245, 130, 48), (60, 180, 75), (145, 30, 180)),
    *((70, 240, 240), (240, 50, 230), (210, 245, 60), (170, 110, 40), (128, 0, 0)),
)
"""Distinct colors, one per prompt; they repeat after the tenth."""
_FONT_SHARE = 32
"""Ratio of the picture's width to the height of a legend's letters, which is at least 11 pixels."""


def tinted(
    image: Float[Tensor, "h w 3"],
    maps: Float[Tensor, "q h w"],
    masks: Bool[Tensor, "q h w"],
    threshold: float,
) -> Float[Tensor, "h w 3"]:
    """Tint each prompt's matches in its own color, in the most relevant prompt's where several match. The
    tint is stronger with relevancy above the threshold."""
    best, which = strongest(maps, masks)
    colors = torch.tensor([PROMPT_COLORS[i % len(PROMPT_COLORS)] for i in range(len(maps))]).to(image) / 255
    strength = _OPACITY * masks.any(0) * (0.5 + 0.5 * heat(best, threshold))
    return torch.lerp(image, colors[which], strength[..., None].to(image))


def with_legend(picture: UInt8[Array, "h w 3"], labels: Sequence[str]) -> UInt8[Array, "h+legend w 3"]:
    """Add lines for each prompt below a picture: a square of its color, and its label."""
    height, width = picture.shape[:2]
    size = max(width // _FONT_SHARE, 11)
    line, font = size + size // 2, letters(size)
    texts = [lines(label, font, max(width - 3 * size, size)).split("\n") for label in labels]
    canvas = Image.new("RGB", (width, height + line * sum(map(len, texts))), "white")
    canvas.paste(Image.fromarray(picture))
    pen, top = ImageDraw.Draw(canvas), height + (line - size) // 2
    for i, text in enumerate(texts):
        left = size // 2
        pen.rectangle((left, top, left + size, top + size), fill=PROMPT_COLORS[i % len(PROMPT_COLORS)])
        for part in text:
            pen.text((2 * size, top + size / 2), part, "black", font, anchor="lm")
            top += line
    return np.asarray(canvas)
