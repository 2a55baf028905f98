"""From a rendered view and prompts to what viewers and renders show: heat maps, overlays, CLIP as colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.query.lookup import CodeScorer
from lang3dxl_ns.query.overlay import overlay
from lang3dxl_ns.query.relevancy import Decode, Queries

_SAMPLE = 4096
"""Codes whose features give the axes of the CLIP colours."""


@dataclass(frozen=True)
class Display:
    """How matches are shown."""

    threshold: float = 0.5
    """Relevancy above which a pixel matches."""
    opacity: float = 0.7
    """Of the heat map over the image, 0…1."""
    colour_map: str = "turbo"
    """One of matplotlib's."""


@dataclass(frozen=True)
class ClipColours:
    """CLIP features as colours: their three principal axes, as red, green and blue."""

    axes: Float[Tensor, "3 c"]
    """Unit length."""
    low: Float[Tensor, "3"]
    """Where the colours begin on the axes; 2nd percentile of the features seen."""
    high: Float[Tensor, "3"]
    """Where they end; 98th percentile."""

    @classmethod
    @torch.no_grad()
    def of(cls, decode: Decode, codes: Float[Tensor, "n d"]) -> ClipColours | None:
        """Axes for the features of these codes (a random sample of them); None for fewer than ten codes."""
        if len(codes) < 10:
            return None
        rows = torch.randperm(len(codes), generator=torch.Generator().manual_seed(0))[:_SAMPLE]
        features = F.normalize(decode(codes[rows.to(codes.device)]), dim=-1)
        axes = torch.linalg.svd(features - features.mean(0), full_matrices=False).Vh[:3]
        # The sign of an axis is arbitrary: the largest of its numbers is made positive.
        axes = axes * axes.gather(1, axes.abs().argmax(1, keepdim=True)).sign()
        places = features @ axes.T
        return cls(axes, places.quantile(0.02, dim=0), places.quantile(0.98, dim=0))

    def paint(self, cosines: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
        """Colours in 0…1 of features with these cosines to the axes."""
        return ((cosines - self.low) / (self.high - self.low).clamp_min(1e-6)).clamp(0, 1)


NOTHING = Queries(torch.zeros(0, 0), (), ())
"""No prompt at all."""


@dataclass(frozen=True)
class Asked:
    """The prompts in hand, and how views are to show where they are."""

    scorer: CodeScorer
    """Through the lookup table, or exact."""
    queries: Queries = NOTHING
    confining: int = 0
    """How many of the last queries say where the others may be found at all, instead of what to show."""
    min_alpha: float = 0.3
    """Coverage below which a pixel shows nothing."""
    highest: float | None = None
    """Relevancy that gets the colour map's last colour; None: the highest of each view."""
    colours: ClipColours | None = None
    """None: no picture of the CLIP features."""
    display: Display = field(default_factory=Display)

    @torch.no_grad()
    def outputs(
        self, image: Float[Tensor, "h w 3"], codes: Float[Tensor, "h w d"], alpha: Float[Tensor, "h w"]
    ) -> dict[str, Float[Tensor, "h w k"]]:
        """`relevancy_0` … [h, w, 1], one per prompt; `overlay`, the heat map of the best of them over the
        image (the image itself where nothing is asked for); `clip_pca` [h, w, 3]. A code is decoded once."""
        keep, found = alpha >= self.min_alpha, {"overlay": image}
        directions = [self.queries.vectors] if len(self.queries) else []
        directions += [self.colours.axes] if self.colours else []
        if not directions:
            return found
        prompts = replace(self.queries, vectors=torch.cat(directions))
        cosines = self.scorer.cosines(codes[keep], prompts)
        if len(prompts):
            maps = codes.new_zeros(len(prompts), *keep.shape)
            maps[:, keep] = prompts.relevancy_of_cosines(cosines, self.scorer.temperature)
            if self.confining:
                maps, within = maps.tensor_split([-self.confining])
                maps = maps * (within.amax(0) > 0.5)
            found = relevancy_outputs(image, maps.unbind(), self.display, self.highest)
        if self.colours is not None:
            found["clip_pca"] = torch.zeros_like(image)
            found["clip_pca"][keep] = self.colours.paint(cosines[:, -3:])
        return found


def relevancy_outputs(
    image: Float[Tensor, "h w 3"],
    maps: Sequence[Float[Tensor, "h w"]],
    display: Display,
    highest: float | None = None,
) -> dict[str, Float[Tensor, "h w k"]]:
    """`overlay` and `relevancy_0` … of the relevancies of one or more prompts."""
    best = torch.stack(list(maps)).amax(0)
    d = display
    pictures = {"overlay": overlay(image, best, d.threshold, d.opacity, d.colour_map, highest)}
    return pictures | {f"relevancy_{i}": one[..., None] for i, one in enumerate(maps)}
