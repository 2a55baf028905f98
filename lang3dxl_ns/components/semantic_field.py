"""Semantic field: a per-pixel decoder from bottleneck codes to CLIP and dense features.

The rendered code of a pixel is the *coordinate* of a multi-resolution hash grid. So the field is indexed by
feature value, not by position, and repeated structures share codes (Lang3D-XL). An MLP turns the encoding
into CLIP features and, through the same hidden layers, dense (DINO) features.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.components.feature_decoder import Decoder, Features
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.components.hash_grid import COORDINATE_LIMIT, HashGrid
from lang3dxl_ns.components.linear import linear


class SemanticField(Decoder):
    """Decoder of rendered codes to raw (not unit length) CLIP features and, if configured, dense features.

    Codes may be any number: ±inf decode to finite features, NaN to NaN in their own pixel alone. Everything
    is per pixel, so large maps can be decoded in chunks. A `dense_dim` of 0 omits the dense head; `generator`
    draws the initial weights.
    """

    settings: SemanticFieldConfig
    code_dim: int

    def __init__(
        self,
        config: SemanticFieldConfig,
        clip_dim: int,
        dense_dim: int = 0,
        *,
        generator: torch.Generator | None = None,
    ):
        super().__init__(clip_dim, dense_dim)
        self.settings = s = config.resolved()
        self.code_dim = s.code_dim
        self.grid = HashGrid(
            s.code_dim + s.indexed, s.levels, s.features_per_level, s.log2_table_size, s.min_resolution,
            s.max_resolution, generator=generator,
        )  # fmt: skip
        grid_dim = clip_dim if s.indexed else self.grid.output_dim
        fourier_dim = s.code_dim * (1 + 2 * s.fourier_frequencies) if s.fourier_frequencies else 0
        self.layers = _hidden_layers(grid_dim + fourier_dim, s, generator)
        self.output = linear(s.hidden_width, clip_dim + dense_dim, generator)

    @property
    def bounded(self) -> bool:  # type: ignore[override]
        return self.settings.bounding == "sigmoid"

    def initial_codes(self, count: int) -> Float[Tensor, "count code"]:
        """Sample initial codes, one per Gaussian."""
        return (self.settings.code_std * torch.randn(count, self.code_dim)).to(self.output_mean)

    def set_output_statistics(self, mean: Float[Tensor, " out"], std: Float[Tensor, " out"]) -> None:
        """Set the targets' statistics (see `Decoder.set_output_statistics`), which need `whiten`."""
        if self.settings.whiten:
            super().set_output_statistics(mean, std)

    def forward(self, codes: Float[Tensor, "*batch code"]) -> Features:
        """Decode the CLIP and dense features of every code."""
        hidden = self.hidden(codes)
        clip = F.linear(hidden, *self._head(slice(0, self.clip_dim)))
        dense = F.linear(hidden, *self._head(slice(self.clip_dim, None))) if self.dense_dim else None
        return clip, dense

    def decode_clip(self, codes: Float[Tensor, "*batch code"]) -> Float[Tensor, "*batch clip"]:
        """Decode the CLIP features of every code, without computing the dense ones."""
        return F.linear(self.hidden(codes), *self.clip_head())

    def clip_head(self) -> tuple[Float[Tensor, "clip hidden"], Float[Tensor, " clip"]]:
        """Return weight and bias of the last layer for CLIP features (see `Decoder.clip_head`)."""
        return self._head(slice(0, self.clip_dim))

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters of the hash grid, and those of the MLP, whose weights decay so that CLIP and
        dense features share edges."""
        network = [*self.layers.parameters(), *self.output.parameters()]
        return {"field_encoding": list(self.grid.parameters()), "field_decoder": network}

    def hidden(self, codes: Float[Tensor, "*batch code"]) -> Float[Tensor, "*batch hidden"]:
        """Compute the activations of the last hidden layer."""
        coordinates = self._coordinates(codes.reshape(-1, self.code_dim))
        encoding = self._read_grid(coordinates)
        if self.settings.fourier_frequencies:
            encoding = torch.cat((self._fourier(coordinates), encoding), 1)
        return self.layers(encoding).reshape(*codes.shape[:-1], self.settings.hidden_width)

    def _coordinates(self, codes: Float[Tensor, "n code"]) -> Float[Tensor, "n code"]:
        if self.settings.bounding == "sigmoid":
            return codes.sigmoid()
        return codes.clamp(-COORDINATE_LIMIT, COORDINATE_LIMIT)

    def _read_grid(self, coordinates: Float[Tensor, "n code"]) -> Float[Tensor, "n channels"]:
        if not self.settings.indexed:
            return self.grid(coordinates)
        passes = math.ceil(self.clip_dim / self.grid.output_dim)
        index = torch.arange(passes, device=coordinates.device, dtype=coordinates.dtype) / passes
        index = index.expand(len(coordinates), -1)[..., None]
        points = torch.cat((index, coordinates[:, None].expand(-1, passes, -1)), 2)
        features = self.grid(points.flatten(0, 1))
        return features.reshape(len(coordinates), passes * self.grid.output_dim)[:, : self.clip_dim]

    def _fourier(self, coordinates: Float[Tensor, "n code"]) -> Float[Tensor, "n features"]:
        octaves = 2.0 ** torch.arange(self.settings.fourier_frequencies, device=coordinates.device)
        angles = (coordinates[..., None] * (2 * math.pi * octaves.to(coordinates))).flatten(1)
        return torch.cat((coordinates, angles.sin(), angles.cos()), 1)

    def _head(self, channels: slice) -> tuple[Float[Tensor, "out hidden"], Float[Tensor, " out"]]:
        """Return weight and bias of the last layer for some of its outputs, with whitening folded in. Scaling
        its few weights costs less than scaling a feature map."""
        std = self.output_std[channels]
        weight = self.output.weight[channels] * std[:, None]
        return weight, self.output.bias[channels] * std + self.output_mean[channels]


def _hidden_layers(
    inputs: int, settings: SemanticFieldConfig, generator: torch.Generator | None
) -> nn.Sequential:
    layers: list[nn.Module] = []
    for depth in range(settings.hidden_layers):
        layers.append(linear(settings.hidden_width if depth else inputs, settings.hidden_width, generator))
        if settings.activation == "every" or depth == settings.hidden_layers - 1:
            layers.append(nn.ReLU())
    return nn.Sequential(*layers)
