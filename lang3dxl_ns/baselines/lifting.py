"""Uncompressed features on the Gaussians: averaged from the photos (lifting), or learned from renderings."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.components.feature_decoder import Decoder, Features, Gathered

_LEAST_COVERAGE = 1e-4


class LiftedFeatures(Decoder):
    """Decoder of features that are averaged onto the Gaussians after training, by contribution.

    Gaussians carry nothing in training. Afterwards they carry the lifted features and a 1, whose rendering is
    the coverage. So a map is the mean feature of the visible Gaussians, however little of a pixel they cover.
    """

    needs_lifting = True

    def forward(self, rendered: Float[Tensor, "*batch d"]) -> Features:
        return self._split(rendered[..., :-1] / rendered[..., -1:].clamp_min(_LEAST_COVERAGE))

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
        return self._split(self.output_mean + self.output_std * rendered)
