"""Heat maps and overlays for viewers and renders, from a rendered view and prompts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.query.engine import QueryEngine
from lang3dxl_ns.query.heat_maps import overlay, strongest
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.threshold import EVEN, matching


@dataclass(frozen=True)
class Display:
    """How matches are displayed."""

    threshold: float | None = None
    """Relevancy above which a pixel matches; None: each prompt's own, by the scene."""
    opacity: float = 0.7
    """Opacity of the heat map over the image, 0…1."""
    color_map: str = "turbo"
    """Name of a matplotlib color map."""


NOTHING = Queries(torch.zeros(0, 0), (), ())
"""No prompts."""


@dataclass(frozen=True)
class Asked:
    """The current prompts, and how views display their matches."""

    engine: QueryEngine | None = None
    """None while no prompt can be answered."""
    queries: Queries = NOTHING
    confining: int = 0
    """How many of the last queries restrict where the others may match; these are not displayed."""
    min_alpha: float = 0.3
    """Coverage below which a pixel shows nothing."""
    thresholds: tuple[float, ...] = ()
    """Relevancy above which each query matches, of the scene; empty: `EVEN` for all."""
    highest: float | None = None
    """Relevancy for the color map's last color; None: the highest of each view."""
    display: Display = field(default_factory=Display)

    @cached_property
    def carried(self) -> Float[Tensor, "n d"] | None:
        """Values that Gaussians carry in a rendering that answers the prompts; computed once."""
        return self.engine.carried(self.queries) if self.engine is not None and len(self.queries) else None

    @torch.no_grad()
    def outputs(
        self,
        image: Float[Tensor, "h w 3"],
        rendered: Float[Tensor, "h w d"] | None,
        alpha: Float[Tensor, "h w"],
    ) -> dict[str, Float[Tensor, "h w k"]]:
        """`relevancy_0` … [h, w, 1], one per prompt, and `overlay`, the heat map of their maximum over the
        image (the image itself without prompts). rendered: the composited `carried` values."""
        if self.engine is None or rendered is None or not len(self.queries):
            return {"overlay": image}
        maps = self.engine.maps(rendered, self.queries) * (alpha >= self.min_alpha)
        own = self.thresholds or (EVEN,) * len(maps)
        if self.confining:
            maps, within = maps.tensor_split([-self.confining])
            maps = maps * matching(within, own[len(maps) :]).any(0)
        asked = self.display.threshold
        thresholds = own[: len(maps)] if asked is None else (asked,) * len(maps)
        return relevancy_outputs(image, maps.unbind(), self.display, thresholds, self.highest)


def relevancy_outputs(
    image: Float[Tensor, "h w 3"],
    maps: Sequence[Float[Tensor, "h w"]],
    display: Display,
    thresholds: Sequence[float],
    highest: float | None = None,
) -> dict[str, Float[Tensor, "h w k"]]:
    """`overlay` and `relevancy_0` … from the relevancy maps of one or more prompts."""
    best, _, lowest = strongest(torch.stack(list(maps)), thresholds)
    pictures = {"overlay": overlay(image, best, lowest, display.opacity, display.color_map, highest)}
    return pictures | {f"relevancy_{i}": one[..., None] for i, one in enumerate(maps)}
