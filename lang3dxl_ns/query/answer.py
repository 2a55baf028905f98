"""Answers as pictures: heat maps and overlays of a rendered view, for viewers and renders."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.query.heat_maps import overlay, strongest
from lang3dxl_ns.query.question import Question
from lang3dxl_ns.rendering.render import Rendering


@torch.no_grad()
def pictures(rendering: Rendering, question: Question | None) -> dict[str, Float[Tensor, "h w k"]]:
    """Draw a view's answers: `overlay`, all prompts' heat over the colors, and `relevancy_0` … [h, w, 1].

    Args:
        rendering: the view, rendered with the question's channels.
        question: the prompts; if None, the overlay is the rendering itself.
    """
    if question is None or rendering.channels is None:
        return {"overlay": rendering.rgb}
    maps, masks = question.maps(rendering)
    best, _ = strongest(maps, masks)
    heat = overlay(rendering.rgb, best, masks.any(0), min(question.thresholds))
    return {"overlay": heat} | {f"relevancy_{i}": one[..., None] for i, one in enumerate(maps)}
