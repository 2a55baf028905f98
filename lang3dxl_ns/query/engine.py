"""Query engines: prompts to relevancy maps, decoding Gaussian by Gaussian or pixel by pixel.

Callers treat both alike: they composite the engine's channels in the pass that renders colors, and the engine
computes maps from the result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.query.relevancy import TEMPERATURE, Decode, Queries, calibrated, cosines_of_codes, in_chunks

_CHUNK_MB = 64
_SAMPLE = 4096
"""Number of Gaussians that a calibration uses."""


@dataclass(frozen=True)
class PerGaussian:
    """Engine that composites one relevancy per Gaussian and prompt: Σ w ρ, not divided by coverage. A pixel's
    value is the share of it covered by matching Gaussians, also at edges and half-transparent places.

    Features are decoded once per scene, to as few numbers as the decoder allows. A decoder whose last layer
    is linear, d = W h + b, gives cos(d, t) = ((h, 1) · (Wᵀt, b·t)) / |d|. The hidden activations h and |d|
    therefore suffice, whatever the width of CLIP is. Rows are (h, 1) / |d|.
    """

    rows: Float[Tensor, "n r"]
    """Half-precision row of each Gaussian; 0 for unknown Gaussians."""
    head: Float[Tensor, "r c"] | None = None
    """Matrix (Wᵀ; b), which turns a row into a unit feature. None if rows are unit features already."""
    temperature: float = TEMPERATURE
    """Temperature of the relevancies, for cosines as they are."""

    @classmethod
    @torch.no_grad()
    def of(
        cls, decoder: Decoder, codes: Float[Tensor, "n d"], temperature: float = TEMPERATURE
    ) -> PerGaussian:
        """Decode the codes of Gaussians, where NaN marks an unknown one."""
        layer = decoder.clip_head()
        narrow = layer is not None and layer[0].shape[1] < layer[0].shape[0]
        head = torch.cat([layer[0].T, layer[1][None]]) if narrow and layer else None
        gram = None if head is None else (head.double() @ head.double().T).to(head)

        def decode(part: Float[Tensor, "m d"]) -> Float[Tensor, "m r"]:
            seen = part.isfinite().all(1, keepdim=True)
            part = torch.where(seen, part, 0.0)
            if gram is None:
                rows = F.normalize(decoder.decode_clip(part), dim=-1)
            else:
                rows = F.pad(decoder.hidden(part), (0, 1), value=1.0)
                rows = rows / ((rows @ gram) * rows).sum(1, keepdim=True).clamp_min(1e-12).sqrt()
            # A feature that all but vanishes carries no information, and its row may exceed half precision.
            return torch.where(seen & (rows.abs() < 6e4).all(1, keepdim=True), rows, 0.0).half()

        return cls(in_chunks(decode, codes, decoder.clip_dim, _CHUNK_MB), head, temperature)

    @cached_property
    def known(self) -> Bool[Tensor, " n"]:
        """Which Gaussians have a feature; the others are visible in no photo."""
        return (self.rows != 0).any(1)

    def channels(
        self, queries: Queries, relevancy: Float[Tensor, "q n"] | None = None
    ) -> Float[Tensor, "n q"]:
        """Return the values that Gaussians carry in a rendering that answers these prompts. relevancy: theirs
        (`of_gaussians`), where it is known."""
        return (self.of_gaussians(queries) if relevancy is None else relevancy).T.contiguous()

    def maps(self, rendered: Float[Tensor, "h w q"], queries: Queries) -> Float[Tensor, "q h w"]:
        """Compute the relevancy of every pixel, 0…1, from these channels composited over black."""
        return rendered.permute(2, 0, 1)

    def of_gaussians(self, queries: Queries) -> Float[Tensor, "q n"]:
        """Compute the relevancy of every Gaussian by itself, 0…1; 0 where unknown."""

        def relevancy(cosines: Tensor) -> Tensor:
            return queries.relevancy_of_cosines(cosines, self.temperature).T

        return self.cosines(queries, relevancy).T * self.known

    @torch.no_grad()
    def features(self, which: slice | Int[Tensor, " m"]) -> Float[Tensor, "m c"]:
        """Decode the unit CLIP features of some Gaussians; 0 where unknown."""
        rows = self.rows[which].float()
        return rows if self.head is None else rows @ self.head

    @torch.no_grad()
    def cosines(
        self, queries: Queries, then: Callable[[Tensor], Tensor] = lambda cosines: cosines
    ) -> Float[Tensor, "n k"]:
        """Compute the cosine of every Gaussian with every vector, 0 where unknown, or what `then` makes of
        them, a part of the Gaussians at a time. Those with one vector lie side by side, for maxima."""
        vectors = queries.vectors if self.head is None else queries.vectors @ self.head.T
        width = max(self.rows.shape[1], len(vectors))
        return in_chunks(lambda part: then((vectors @ part.float().T).T), self.rows, width, _CHUNK_MB)

    def calibrated(self, words: Queries) -> PerGaussian:
        """Return this engine with a temperature that suits the encoder (`relevancy.calibrated`), by words
        that are the same for all scenes and encoders (`TextEncoder.yardstick`)."""
        known = self.rows[self.known]
        cosines = replace(self, rows=known[:: max(len(known) // _SAMPLE, 1)]).cosines(words)
        return replace(self, temperature=calibrated(self.temperature, cosines))


@dataclass(frozen=True)
class PerPixel:
    """Engine that composites codes, then decodes each pixel (Lang3D-XL). Its methods are `PerGaussian`'s."""

    decode: Decode
    codes: Float[Tensor, "n d"]
    temperature: float = TEMPERATURE
    head = None

    @property
    def known(self) -> Bool[Tensor, " n"]:
        return self.codes.isfinite().all(1)

    def channels(self, queries: Queries, relevancy: Tensor | None = None) -> Float[Tensor, "n d"]:
        return self.codes

    def maps(self, rendered: Float[Tensor, "h w d"], queries: Queries) -> Float[Tensor, "q h w"]:
        return self._relevancy(rendered.flatten(0, 1), queries).unflatten(1, rendered.shape[:2])

    def of_gaussians(self, queries: Queries) -> Float[Tensor, "q n"]:
        return self._relevancy(self.codes, queries)

    def features(self, which: slice | Int[Tensor, " m"]) -> Float[Tensor, "m c"]:
        return F.normalize(self.decode(self.codes[which]), dim=1)

    def calibrated(self, words: Queries) -> PerPixel:
        cosines = cosines_of_codes(self.decode, self.codes[:: max(len(self.codes) // _SAMPLE, 1)], words)
        return replace(self, temperature=calibrated(self.temperature, cosines))

    def _relevancy(self, codes: Float[Tensor, "m d"], queries: Queries) -> Float[Tensor, "q m"]:
        return queries.relevancy_of_cosines(cosines_of_codes(self.decode, codes, queries), self.temperature)


QueryEngine: TypeAlias = PerGaussian | PerPixel


@torch.no_grad()
def make_engine(
    decoder: Decoder, codes: Float[Tensor, "n d"], temperature: float = TEMPERATURE
) -> QueryEngine:
    """Build the engine for a feature decoder, in the decoder's order of compositing and decoding."""
    if decoder.per_gaussian:
        return PerGaussian.of(decoder, codes, temperature)
    return PerPixel(decoder.decode_clip, codes, temperature)
