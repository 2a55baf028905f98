"""FMGS (Zuo et al. 2024), as adapted by Lang3D-XL: a hash grid over positions, decoded before rendering."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lab.baselines.lifting import split
from lang3dxl_ns.components.feature_decoder import Decoder, Features
from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig
from lang3dxl_ns.components.semantic_field import SemanticField

_ALIGNMENT = 0.01
"""Weight of the loss that aligns CLIP with dense features (published: 0.01 to 0.03)."""
_STRETCH = 2.0
"""Scale of positions before the grid's sigmoid: those within the scene radius fill 0.12 … 0.88 of the grid
almost evenly, and all others share the rest."""


class PlaceField(Decoder):
    """Semantic field evaluated at a Gaussian's position instead of a pixel's code.

    Every Gaussian is decoded, and whole features are rendered. Gaussians have no learned codes."""

    def __init__(self, config: SemanticFieldConfig, clip_dim: int, dense_dim: int) -> None:
        super().__init__(clip_dim, dense_dim)
        # A position has three coordinates, whatever the field's code size.
        self.field = SemanticField(replace(config, code_dim=3, bounding="sigmoid"), clip_dim, dense_dim)
        self.settings = self.field.settings
        self.center: Tensor
        self.radius: Tensor
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("radius", torch.ones(()))

    @classmethod
    def build(
        cls, settings: SemanticFieldConfig, clip_dim: int, compression: CompressionConfig, dense_dim: int
    ) -> PlaceField:
        return cls(settings, clip_dim, dense_dim)

    def set_extent(self, center: Float[Tensor, "3"], radius: float) -> None:
        self.center.copy_(center)
        self.radius.fill_(radius)

    def carried(self, gaussians: Mapping[str, Tensor] | nn.ParameterDict) -> Float[Tensor, "n d"]:
        """Decode the features at the Gaussians' positions; positions get no gradient."""
        places = _STRETCH * (gaussians["means"].detach() - self.center) / self.radius
        clip, dense = self.field(places)
        return clip if dense is None else torch.cat([clip, dense], dim=-1)

    def forward(self, rendered: Float[Tensor, "*batch d"]) -> Features:
        return split(self, rendered)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return self.field.parameter_groups()

    def own_losses(
        self, clip: Float[Tensor, "h w clip"], dense: Float[Tensor, "h w dense"] | None
    ) -> dict[str, Float[Tensor, ""]]:
        if dense is None:
            return {}
        return {"alignment": _ALIGNMENT * pixel_alignment_loss(clip, dense)}

    def set_output_statistics(self, mean: Float[Tensor, " out"], std: Float[Tensor, " out"]) -> None:
        self.field.set_output_statistics(mean, std)


def pixel_alignment_loss(clip: Float[Tensor, "h w c"], dense: Float[Tensor, "h w d"]) -> Float[Tensor, ""]:
    """Average how far CLIP and dense features differ in neighbor similarity; dense ones get no gradient."""
    return (neighbor_similarity(clip) - neighbor_similarity(dense.detach())).abs().mean()


def neighbor_similarity(features: Float[Tensor, "h w c"]) -> Float[Tensor, "h w 8"]:
    """Compute the cosine of every pixel with its eight neighbors; the map is mirrored at the border."""
    height, width, _ = features.shape
    unit = F.normalize(features, dim=-1)
    padded = F.pad(unit.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="reflect")[0].permute(1, 2, 0)
    shifts = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
    return torch.stack([(unit * padded[y : y + height, x : x + width]).sum(-1) for y, x in shifts], dim=-1)
