"""Query engines: prompts to relevancy maps, decoding Gaussian by Gaussian or pixel by pixel.

Callers treat both alike: they composite the engine's channels in the pass that renders colors, and the engine
computes maps from the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.query.gaussian_relevancy import GaussianFeatures
from lang3dxl_ns.query.relevancy import (
    TEMPERATURE,
    Decode,
    Queries,
    calibrated,
    cosines_of_codes,
    relevancy_of_codes,
)

_SAMPLE = 4096
"""Number of Gaussians that a calibration uses."""


class QueryEngine(Protocol):
    """Interface of an engine that answers prompts about a scene."""

    @property
    def temperature(self) -> float:
        """Temperature of the relevancies, for cosines as they are."""

    def channels(self, queries: Queries) -> Float[Tensor, "n d"]:
        """Return the values that Gaussians carry in a rendering that answers these prompts."""

    def maps(self, rendered: Float[Tensor, "h w d"], queries: Queries) -> Float[Tensor, "q h w"]:
        """Compute the relevancy of every pixel, 0…1, from these channels composited over black."""

    def of_gaussians(self, queries: Queries) -> Float[Tensor, "q n"]:
        """Compute the relevancy of every Gaussian by itself, 0…1."""

    def features(self, rows: slice | Int[Tensor, " m"]) -> Float[Tensor, "m c"]:
        """Decode the unit CLIP features of some Gaussians; 0 for those visible in no photo."""

    @property
    def head(self) -> Float[Tensor, "r c"] | None:
        """Vectors that span all features, if they are fewer than CLIP's channels; otherwise None."""

    def calibrated(self, words: Queries) -> QueryEngine:
        """Return this engine with a temperature that suits the encoder, as computed by
        `relevancy.calibrated`.

        words: a fixed set for all scenes and encoders, `TextEncoder.yardstick`.
        """


@dataclass(frozen=True)
class PerGaussian:
    """Engine that composites one relevancy per Gaussian and prompt: Σ w ρ, not divided by coverage. A pixel's
    value is the share of it covered by matching Gaussians, also at edges and half-transparent places."""

    decoded: GaussianFeatures
    temperature: float = TEMPERATURE

    def channels(self, queries: Queries) -> Float[Tensor, "n q"]:
        return self.of_gaussians(queries).T.contiguous()

    def maps(self, rendered: Float[Tensor, "h w q"], queries: Queries) -> Float[Tensor, "q h w"]:
        return rendered.permute(2, 0, 1)

    def of_gaussians(self, queries: Queries) -> Float[Tensor, "q n"]:
        return self.decoded.relevancy(queries, self.temperature)

    def features(self, rows: slice | Int[Tensor, " m"]) -> Float[Tensor, "m c"]:
        return self.decoded.features(rows)

    @property
    def head(self) -> Float[Tensor, "r c"] | None:
        return self.decoded.head

    def calibrated(self, words: Queries) -> PerGaussian:
        cosines = self.decoded.some(_SAMPLE).cosines(words)
        return replace(self, temperature=calibrated(self.temperature, cosines))


@dataclass(frozen=True)
class PerPixel:
    """Engine that composites codes, then decodes them pixel by pixel, as in Lang3D-XL."""

    decode: Decode
    codes: Float[Tensor, "n d"]
    temperature: float = TEMPERATURE
    head = None

    def channels(self, queries: Queries) -> Float[Tensor, "n d"]:
        return self.codes

    def maps(self, rendered: Float[Tensor, "h w d"], queries: Queries) -> Float[Tensor, "q h w"]:
        return relevancy_of_codes(self.decode, rendered, queries, temperature=self.temperature)

    def of_gaussians(self, queries: Queries) -> Float[Tensor, "q n"]:
        return relevancy_of_codes(self.decode, self.codes, queries, temperature=self.temperature)

    def features(self, rows: slice | Int[Tensor, " m"]) -> Float[Tensor, "m c"]:
        return F.normalize(self.decode(self.codes[rows]), dim=1)

    def calibrated(self, words: Queries) -> PerPixel:
        cosines = cosines_of_codes(self.decode, self.codes[:: max(len(self.codes) // _SAMPLE, 1)], words)
        return replace(self, temperature=calibrated(self.temperature, cosines))


@torch.no_grad()
def make_engine(
    decoder: Decoder, codes: Float[Tensor, "n d"], temperature: float = TEMPERATURE
) -> QueryEngine:
    """Build the engine for a feature decoder, in the decoder's order of compositing and decoding."""
    if decoder.per_gaussian:
        return PerGaussian(GaussianFeatures.of(decoder, codes), temperature)
    return PerPixel(decoder.decode_clip, codes, temperature)
