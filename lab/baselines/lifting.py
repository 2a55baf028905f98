"""Baselines without a network: lifted or learned features on the Gaussians, or wide codes (Feature 3DGS)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.components.feature_decoder import Decoder, Features, Gathered, LearningDecoder

_LEAST_COVERAGE = 1e-4


def split(decoder: Decoder, features: Float[Tensor, "*batch out"]) -> Features:
    """Separate a decoder's CLIP features from its dense ones, if it has some."""
    dense = features[..., decoder.clip_dim :] if decoder.dense_dim else None
    return features[..., : decoder.clip_dim], dense


class LiftedFeatures(LearningDecoder):
    """Decoder of features that are averaged onto the Gaussians after training, by contribution.

    Gaussians then also carry a 1, whose rendering is the coverage. So a map is the mean feature of the
    visible Gaussians, however little of a pixel they cover."""

    needs_lifting = True

    def forward(self, rendered: Float[Tensor, "*batch d"]) -> Features:
        return split(self, rendered[..., :-1] / rendered[..., -1:].clamp_min(_LEAST_COVERAGE))

    def learn_gaussians(
        self, gathered: Gathered, advance: Callable[[], None] = lambda: None
    ) -> Float[Tensor, "n d"]:
        features = gathered.features
        return torch.cat([features, (gathered.mass > 0).to(features)[:, None]], dim=1)


class DirectFeatures(Decoder):
    """Decoder of whitened CLIP and dense features that Gaussians learn with the scene.

    A map is mean + deviation × rendering, so training starts at the mean feature, as for the semantic field.
    """

    def initial_codes(self, count: int) -> Float[Tensor, "count code"]:
        return self.output_mean.new_zeros(count, len(self.output_mean))

    def forward(self, rendered: Float[Tensor, "*batch d"]) -> Features:
        return split(self, self.output_mean + self.output_std * rendered)


class Feature3DGS(Decoder):
    """Decoder of codes half as wide as CLIP's features (256 for ViT-B/32) by the method's "speed-up" layer.

    This 1×1 convolution outputs CLIP and dense features. They are whitened as in the semantic field, which
    can only help this baseline."""

    code_dim: int

    def __init__(self, clip_dim: int, dense_dim: int) -> None:
        super().__init__(clip_dim, dense_dim)
        self.code_dim = max(clip_dim // 2, 1)
        self.layer = nn.Linear(self.code_dim, clip_dim + dense_dim)

    def initial_codes(self, count: int) -> Float[Tensor, "count code"]:
        return self.output_mean.new_zeros(count, self.code_dim)

    def forward(self, rendered: Float[Tensor, "*batch d"]) -> Features:
        return split(self, self.output_mean + self.output_std * self.layer(rendered))

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"field_decoder": list(self.layer.parameters())}
