"""Feature 3DGS (Zhou et al. 2024): wide codes on the Gaussians, one linear layer after rendering."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.components.feature_decoder import Decoder, Features


class Feature3DGS(Decoder):
    """Decoder of codes half as wide as CLIP's features (256 for ViT-B/32) by the method's "speed-up" layer.

    This 1×1 convolution outputs CLIP and dense features. They are whitened as in the semantic field, which
    can only help this baseline."""

    def __init__(self, clip_dim: int, dense_dim: int) -> None:
        super().__init__(clip_dim, dense_dim)
        self.code_dim = max(clip_dim // 2, 1)
        self.layer = nn.Linear(self.code_dim, clip_dim + dense_dim)

    def initial_codes(self, count: int) -> Float[Tensor, "count code"]:
        return self.output_mean.new_zeros(count, self.code_dim)

    def forward(self, rendered: Float[Tensor, "*batch d"]) -> Features:
        return self._split(self.output_mean + self.output_std * self.layer(rendered))

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"feature3dgs_decoder": list(self.layer.parameters())}
