"""A question: prompts put to one scene, settings of queries, and everything that the answers share.

All code that shows matches, in pixels or in Gaussians, goes through a question. Thresholds, doubt and the
restriction to a foreground are therefore decided here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.image import resize_nearest
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.query.engine import QueryEngine
from lang3dxl_ns.query.heat_maps import overlay, strongest
from lang3dxl_ns.query.relevancy import TEMPERATURE, Queries
from lang3dxl_ns.query.text import Prompt, TextConfig
from lang3dxl_ns.query.thresholds import matching
from lang3dxl_ns.query.trust import Trust
from lang3dxl_ns.rendering import Rendering

COVERED = 0.3
"""Share of a pixel that matching Gaussians must cover; below 0.5, because most are small and edges blend."""
_BOUNDS = {
    "temperature": (1e-3, 1e4),
    "threshold": (0, 1),
    "min_alpha": (0, 1),
    "size": (1, 1 << 16),
    "views": (1, 1e6),
    "view_side": (8, 8192),
}


@showing("threshold", "foreground")
@dataclass(frozen=True)
class QueryConfig:
    """Settings of queries."""

    text: TextConfig = field(default_factory=TextConfig)
    """How prompts become vectors: synonyms, their combination, and negatives."""
    temperature: float = TEMPERATURE
    """Softmax temperature of the relevancy, for an encoder whose cosines spread like the built-in CLIP's;
    cosines of other encoders are scaled. It does not change the ranking of Gaussians."""
    threshold: float | None = None
    """Relevancy above which Gaussians match. Default: set by what stands out in the scene, at most 0.5."""
    min_alpha: float = 0.3
    """Coverage below which a pixel cannot match."""
    foreground: str = ""
    """Restrict matches to what this prompt finds, such as `building`. The view of a photo with a foreground
    mask is restricted to that mask as well."""
    size: int | None = None
    """Longer side of pictures in pixels. Default: the photo's own, at most 1920."""
    views: int = 100
    """Number of training views, evenly spread, that `find` chooses from."""
    view_side: int = 256
    """Longer side in pixels of the views in which visible Gaussians are measured."""

    def __post_init__(self) -> None:
        """Raise UserError if an option is invalid."""
        check_numbers(self, _BOUNDS)


@dataclass(frozen=True, eq=False, repr=False)
class Question:
    """Prompts, their vectors, and the thresholds above which places of the scene match them."""

    engine: QueryEngine
    prompts: tuple[Prompt, ...]
    queries: Queries
    """Vectors of the prompts, followed by those of the foreground prompts, if any."""
    everywhere: Float[Tensor, "all n"]
    """Relevancy of every Gaussian to all of these."""
    doubts: tuple[float, ...] = ()
    """Share of unrelated words that match the scene as well, one per prompt."""
    trusts: tuple[Trust, ...] = ()
    """How far to believe the answers, one per prompt."""
    thresholds: tuple[float, ...] = ()
    """Relevancy above which Gaussians match, one per prompt."""
    foreground_thresholds: tuple[float, ...] = ()
    """Relevancy above which Gaussians match, one per foreground prompt."""
    min_alpha: float = 0.3
    """Coverage below which a pixel matches nothing."""

    def __repr__(self) -> str:
        return f"Question({', '.join(repr(prompt.text) for prompt in self.prompts)})"

    @cached_property
    def channels(self) -> Float[Tensor, "n d"]:
        """Values that Gaussians carry in a rendering: the engine's, then 1 per prompt that they match."""
        own = self.engine.channels(self.queries, self.everywhere)
        return torch.cat([own, self.gaussians.T.to(own)], dim=1)

    @cached_property
    def relevancy(self) -> Float[Tensor, "q n"]:
        """Relevancy of every Gaussian to every prompt, 0…1; 0 outside the foreground."""
        return self._confined(self.everywhere)

    @cached_property
    def gaussians(self) -> Bool[Tensor, "q n"]:
        """Mask of the Gaussians that match each prompt."""
        return matching(self.relevancy, self.thresholds)

    @torch.no_grad()
    def maps(
        self, rendering: Rendering, foreground: Bool[Tensor, "h w"] | None = None
    ) -> tuple[Float[Tensor, "q h w"], Bool[Tensor, "q h w"]]:
        """Compute the relevancy of every pixel to every prompt, 0…1, and the pixels that match: those covered
        by matching Gaussians, so that a view shows the scene's selection. Pixels outside the foreground (at
        any size; None: all are inside), and those that the scene hardly covers, are 0 and match nothing. The
        rendering has `channels`, composited at its size or at another."""
        assert rendering.channels is not None
        keep, size = rendering.alpha >= self.min_alpha, (rendering.camera.height, rendering.camera.width)
        if foreground is not None:
            keep = keep & resize_nearest(foreground, size).to(keep.device)
        count = len(self.prompts)
        values, covered = rendering.channels.tensor_split([-count], dim=2)
        maps = torch.cat([self._confined(self.engine.maps(values, self.queries)), covered.permute(2, 0, 1)])
        if maps.shape[1:] != size:
            maps = F.interpolate(maps[None].float(), size, mode="bilinear", align_corners=False)[0]
        return maps[:count] * keep, (maps[count:] >= COVERED) & keep

    def _confined(self, relevancy: Float[Tensor, "all ..."]) -> Float[Tensor, "q ..."]:
        """Return the relevancy to the prompts, set to 0 where no foreground prompt matches."""
        count = len(self.prompts)
        wanted, within = relevancy[:count], relevancy[count:]
        if not len(within):
            return wanted
        return wanted * matching(within, self.foreground_thresholds).any(0)


@torch.no_grad()
def pictures(rendering: Rendering, question: Question | None) -> dict[str, Float[Tensor, "h w k"]]:
    """Draw a view's answers for viewers: `overlay`, all prompts' heat over the colors, and `relevancy_0` …
    [h, w, 1]. Without a question, or its channels in the rendering, the overlay is the rendering itself."""
    if question is None or rendering.channels is None:
        return {"overlay": rendering.rgb}
    maps, masks = question.maps(rendering)
    best, _ = strongest(maps, masks)
    heat = overlay(rendering.rgb, best, masks.any(0), min(question.thresholds))
    return {"overlay": heat} | {f"relevancy_{i}": one[..., None] for i, one in enumerate(maps)}
