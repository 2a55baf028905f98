"""Semantic field: a per-pixel decoder from bottleneck codes to CLIP and dense features.

The rendered code of a pixel is the *coordinate* of a multi-resolution hash grid. So the field is indexed by
feature value, not by position, and repeated structures share codes (Lang3D-XL). An MLP turns the encoding
into CLIP features and, through the same hidden layers, dense (DINO) features.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.components.feature_decoder import Decoder, Features
from lang3dxl_ns.components.hash_grid import COORDINATE_LIMIT, MOST_DIMENSIONS, HashGrid
from lang3dxl_ns.components.linear import linear

Preset = Literal["short", "paper", "official"]


_T = TypeVar("_T")
_UNSET: Any = None
if TYPE_CHECKING:  # only settings that `resolved` has completed are read, and those have every value
    _OrPreset = Annotated[_T, None]
else:
    _OrPreset = _T | None


@showing("preset", "code_dim")
@dataclass(frozen=True)
class SemanticFieldConfig:
    """Settings of a semantic field: a preset, and values that override it."""

    preset: Preset | Literal["auto"] = "auto"
    """Values of all unset options. `short`: for hundreds to a few thousand steps, and for codes that are
    learned after training. `paper`: as printed. `official`: as released by the authors. `auto`: `short` for
    those, in runs of under 5,000 iterations, and where the length is unknown; otherwise `paper`."""
    code_dim: _OrPreset[int] = _UNSET
    """Channels of the rendered code, 2 to 6 (2 to 5 with `indexed`). Each doubles the cost of a lookup."""
    code_std: _OrPreset[float] = _UNSET
    """Standard deviation of the initial codes. Presets keep it small, because a wide start scatters equal
    surfaces over the field."""
    bounding: _OrPreset[Literal["sigmoid", "raw"]] = _UNSET
    """How a code becomes a coordinate. `sigmoid`: it is mapped into (0, 1), where distinct cells have
    distinct vertices. `raw`: it is unchanged, and codes outside [0, 1] share entries with those inside."""
    fourier_frequencies: _OrPreset[int] = _UNSET
    """Octaves of sines and cosines of the coordinate, as inputs beside the grid's features; 0 for none. The
    longest has one wave per unit."""
    indexed: _OrPreset[bool] = _UNSET
    """Prepend an index coordinate to the code and look up at index 0, 1/k, 2/k, … until there are as many
    channels as CLIP has (Lang3D-XL). Otherwise the grid is read once."""
    levels: _OrPreset[int] = _UNSET
    """Number of levels of the hash grid; 0 for Fourier features only."""
    features_per_level: _OrPreset[int] = _UNSET
    """Number of features per level of the hash grid."""
    log2_table_size: _OrPreset[int] = _UNSET
    """Log2 of the maximum number of entries per level."""
    min_resolution: _OrPreset[int] = _UNSET
    """Vertices per axis of the coarsest level."""
    max_resolution: _OrPreset[int] = _UNSET
    """Vertices per axis of the finest level. Presets keep it low, because Adam with epsilon 1e-15 moves every
    touched entry equally far: fine levels would grow as large as coarse ones, and neighboring codes would
    decode to unrelated features."""
    hidden_layers: _OrPreset[int] = _UNSET
    """Number of hidden linear layers of the decoder."""
    hidden_width: _OrPreset[int] = _UNSET
    """Number of channels of a hidden layer."""
    activation: _OrPreset[Literal["every", "last"]] = _UNSET
    """Whether a ReLU follows `every` hidden layer, or only the `last` (as printed in the paper)."""
    whiten: _OrPreset[bool] = _UNSET
    """Output mean + deviation × network, with the targets' statistics, so that training starts at their mean.
    Otherwise the network's output is used as it is."""

    def resolved(self) -> SemanticFieldConfig:
        """Return all settings, with unset ones taken from the preset. Raises UserError if the preset is
        unknown, the code has too many or too few channels for the grid, or the decoder has no hidden layer or
        no input."""
        name = "short" if self.preset == "auto" else self.preset
        if name not in PRESETS:
            raise UserError(f"unknown field preset {name!r}: choose one of auto, {', '.join(PRESETS)}")
        given = {key: value for key, value in vars(self).items() if value is not None}
        settings = replace(PRESETS[name], **given | {"preset": name})
        if settings.hidden_layers < 1:
            raise UserError(f"hidden_layers is {settings.hidden_layers}: the decoder needs at least one")
        if settings.min_resolution > settings.max_resolution:
            raise UserError(
                f"min_resolution {settings.min_resolution} is above max_resolution {settings.max_resolution}"
            )
        if settings.levels == 0 and (settings.fourier_frequencies == 0 or settings.indexed):
            raise UserError("without levels the decoder sees Fourier features alone: set fourier_frequencies")
        most = MOST_DIMENSIONS - settings.indexed
        if not 2 <= settings.code_dim <= most:
            raise UserError(
                f"code_dim is {settings.code_dim}, but the hash grid reads 2 to {most} code channels"
                f"{' beside the index coordinate' if settings.indexed else ''}: choose code_dim in that range"
            )
        return settings


_PAPER = SemanticFieldConfig(
    # Values as printed. The index coordinate is kept, not folded into a wider row, so the table has the
    # printed size. Values that the paper does not give (range, initial codes, features per level) are safe
    # choices.
    "paper", code_dim=3, code_std=0.01, bounding="sigmoid", fourier_frequencies=0, indexed=True, levels=16,
    features_per_level=8, log2_table_size=8, min_resolution=16, max_resolution=2048, hidden_layers=3,
    hidden_width=512, activation="last", whiten=False,
)  # fmt: skip
PRESETS: dict[Preset, SemanticFieldConfig] = {
    # A hash grid alone needs thousands of steps; Fourier features and a small grid learn within hundreds.
    "short": replace(
        _PAPER, preset="short", fourier_frequencies=4, indexed=False, levels=8, features_per_level=4,
        log2_table_size=12, max_resolution=256, hidden_layers=1, hidden_width=64, activation="every",
        whiten=True,
    ),
    "paper": _PAPER,
    # The values of the code that the authors released.
    "official": replace(
        _PAPER, preset="official", code_std=0.0, bounding="raw", log2_table_size=19, hidden_layers=2,
        activation="every",
    ),
}  # fmt: skip
"""Complete settings of each preset."""


class SemanticField(Decoder):
    """Decoder of rendered codes to raw (not unit length) CLIP features and, if configured, dense features.

    Codes may be any number: ±inf decode to finite features, NaN to NaN in their own pixel alone. Everything
    is per pixel, so large maps can be decoded in chunks. A `dense_dim` of 0 omits the dense head; `generator`
    draws the initial weights.
    """

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
