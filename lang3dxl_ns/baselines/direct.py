"""Direct baseline: the whole feature on every Gaussian, without compression."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.components.feature_decoder import Decoder


class DirectFeatures(Decoder):
    """Decoder without compression: Gaussians carry whitened CLIP and dense features.

    A map is mean + deviation × rendering, so training starts at the mean feature, as for the semantic field.
    """

    def initial_codes(
        self, count: int, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count code"]:
        return self.output_mean.new_zeros(count, len(self.output_mean))

    def forward(
        self, rendered: Float[Tensor, "*batch d"]
    ) -> tuple[Float[Tensor, "*batch clip"], Float[Tensor, "*batch dense"] | None]:
        return self._split(self.output_mean + self.output_std * rendered)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {}
