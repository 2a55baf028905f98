"""Answers as pictures: heat maps and overlays of a rendered view, for viewers and renders."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.query.heat_maps import overlay, strongest
from lang3dxl_ns.query.question import Question
from lang3dxl_ns.rendering.render import Rendering


@dataclass(frozen=True)
class Display:
    """How matches are displayed."""

    threshold: float | None = None
    """Relevancy above which a pixel matches; None: each prompt's own, by the scene."""
    opacity: float = 0.7
    """Opacity of the heat map over the image, 0…1."""
    color_map: str = "turbo"
    """Name of a matplotlib color map."""
    highest: float | None = None
    """Relevancy for the color map's last color; None: the highest of each view."""


@torch.no_grad()
def pictures(
    rendering: Rendering, question: Question | None, display: Display | None = None
) -> dict[str, Float[Tensor, "h w k"]]:
    """`overlay`, the heat map of all prompts over the rendering, and `relevancy_0` … [h, w, 1].

    Args:
        rendering: a view, rendered with the question's channels.
        question: the prompts; None: the overlay is the rendering itself.
        display: how matches are displayed.

    Raises:
        UserError: matplotlib has no color map of this name.
    """
    if question is None or rendering.channels is None:
        return {"overlay": rendering.rgb}
    display, maps = display or Display(), question.maps(rendering)
    own = question.thresholds if display.threshold is None else (display.threshold,) * len(maps)
    best, _, lowest = strongest(maps, own)
    heat = overlay(rendering.rgb, best, lowest, display.opacity, display.color_map, display.highest)
    return {"overlay": heat} | {f"relevancy_{i}": one[..., None] for i, one in enumerate(maps)}
