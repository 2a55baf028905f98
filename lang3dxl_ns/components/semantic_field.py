"""The semantic field: a per-pixel decoder from bottleneck codes to CLIP and dense features.

The rendered code of a pixel is the *coordinate* of a multi-resolution hash grid, so the field is indexed by
feature value and not by place: repeated structures share codes (Lang3D-XL). An MLP turns the encoding into
CLIP features and, through the same hidden layers, dense (DINO) features.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.components.encoder import SemanticEncoder
from lang3dxl_ns.components.hash_grid import COORDINATE_LIMIT, MOST_DIMENSIONS, HashGrid
from lang3dxl_ns.errors import UserError

Preset = Literal["default", "short", "paper", "official"]


@dataclass(frozen=True)
class FieldSettings:
    """Every setting of a semantic field, none left open; `SemanticFieldConfig` documents each."""

    code_dim: int
    code_std: float
    bounding: Literal["sigmoid", "raw"]
    fourier_frequencies: int
    indexed: bool
    levels: int
    features_per_level: int
    log2_table_size: int
    min_resolution: int
    max_resolution: int
    coarse_to_fine: float
    hidden_layers: int
    hidden_width: int
    activation: Literal["every", "last"]
    whiten: bool


PRESETS: dict[Preset, FieldSettings] = {
    # One lookup of 16 × 32 features does the work of the method's four indexed passes of 16 × 8 in a fraction
    # of the time. The table size is a compromise between room for a large scene and an optimiser's memory.
    "default": FieldSettings(
        code_dim=3,
        code_std=0.01,
        bounding="sigmoid",
        fourier_frequencies=0,
        indexed=False,
        levels=16,
        features_per_level=32,
        log2_table_size=15,
        min_resolution=16,
        max_resolution=512,
        coarse_to_fine=1 / 3,
        hidden_layers=2,
        hidden_width=512,
        activation="every",
        whiten=True,
    ),
    # A hash grid alone needs thousands of steps; Fourier features beside a small one learn within hundreds.
    "short": FieldSettings(
        code_dim=3,
        code_std=0.01,
        bounding="sigmoid",
        fourier_frequencies=4,
        indexed=False,
        levels=8,
        features_per_level=4,
        log2_table_size=12,
        min_resolution=16,
        max_resolution=256,
        coarse_to_fine=0.0,
        hidden_layers=1,
        hidden_width=64,
        activation="every",
        whiten=True,
    ),
    # As printed. The index coordinate is kept, not folded into a wider row: with it the table has the printed
    # size. Where the paper is silent (range, initial codes, features per level) this takes the safe choice.
    "paper": FieldSettings(
        code_dim=3,
        code_std=0.01,
        bounding="sigmoid",
        fourier_frequencies=0,
        indexed=True,
        levels=16,
        features_per_level=8,
        log2_table_size=8,
        min_resolution=16,
        max_resolution=2048,
        coarse_to_fine=0.0,
        hidden_layers=3,
        hidden_width=512,
        activation="last",
        whiten=False,
    ),
    # As released by the authors.
    "official": FieldSettings(
        code_dim=3,
        code_std=0.0,
        bounding="raw",
        fourier_frequencies=0,
        indexed=True,
        levels=16,
        features_per_level=8,
        log2_table_size=19,
        min_resolution=16,
        max_resolution=2048,
        coarse_to_fine=0.0,
        hidden_layers=2,
        hidden_width=512,
        activation="every",
        whiten=False,
    ),
}


@dataclass
class SemanticFieldConfig:
    """Settings of a semantic field: a preset, and whatever is set here instead of the preset's value."""

    preset: Preset | Literal["auto"] = "auto"
    """`default`: long GPU run; `short`: 300 to 1,000 steps on a CPU; `paper`: as printed; `official`: as
    released; `auto`: chosen by the length of the run (`default` where none is known)."""
    code_dim: int | None = None
    """Channels of the rendered code, 2 to 6 (2 to 5 with `indexed`). Each doubles the work of a lookup."""
    code_std: float | None = None
    """Standard deviation of the initial codes. Small: wide starts scatter equal surfaces over the field."""
    bounding: Literal["sigmoid", "raw"] | None = None
    """How a code becomes a coordinate. `sigmoid`: into (0, 1), where distinct cells keep distinct vertices;
    `raw`: as it is, and codes outside [0, 1] reuse entries of those inside."""
    fourier_frequencies: int | None = None
    """Octaves of sines and cosines of the coordinate beside the grid, the longest one wave over the unit;
    0 for none."""
    indexed: bool | None = None
    """Put an index coordinate before the code and look up at index 0, 1/k, 2/k, … until there are as many
    channels as CLIP has (Lang3D-XL). Without it the grid is read once."""
    levels: int | None = None
    """Resolutions of the hash grid; 0 for none, the Fourier features alone."""
    features_per_level: int | None = None
    """Features that each level contributes to a lookup."""
    log2_table_size: int | None = None
    """A level keeps at most 2 to this power entries."""
    min_resolution: int | None = None
    """Vertices per axis of the coarsest level."""
    max_resolution: int | None = None
    """Vertices per axis of the finest level. Capped low, because Adam with epsilon 1e-15 moves every touched
    entry equally far: fine levels would end as loud as coarse ones, and neighbouring codes decode to
    unrelated features."""
    coarse_to_fine: float | None = None
    """Fraction of the run over which levels open, coarsest first; 0 opens all from the start."""
    hidden_layers: int | None = None
    """Hidden linear layers of the decoder."""
    hidden_width: int | None = None
    """Channels of a hidden layer."""
    activation: Literal["every", "last"] | None = None
    """A ReLU after `every` hidden layer or only after the `last` (as printed in the paper)."""
    whiten: bool | None = None
    """Outputs are mean + deviation × network, with the targets' statistics: training starts at their mean."""

    def resolved(self) -> FieldSettings:
        """All settings, the open ones taken from the preset.

        Raises:
            UserError: the preset is unknown, the code has too many or too few channels for the grid, or the
                decoder has no hidden layer or nothing to read.
        """
        name = "default" if self.preset == "auto" else self.preset
        if name not in PRESETS:
            raise UserError(
                f"unknown semantic field preset {name!r}: choose one of auto, {', '.join(PRESETS)}"
            )
        preset = PRESETS[name]
        chosen = {field.name: getattr(self, field.name) for field in fields(FieldSettings)}
        settings = FieldSettings(**{k: getattr(preset, k) if v is None else v for k, v in chosen.items()})
        if settings.hidden_layers < 1:
            raise UserError(f"hidden_layers is {settings.hidden_layers}: the decoder needs at least one")
        if settings.levels == 0 and (settings.fourier_frequencies == 0 or settings.indexed):
            raise UserError("without levels the decoder sees Fourier features alone: set fourier_frequencies")
        most = MOST_DIMENSIONS - settings.indexed
        if not 2 <= settings.code_dim <= most:
            raise UserError(
                f"code_dim is {settings.code_dim}, but the hash grid reads 2 to {most} code channels"
                f"{' beside the index coordinate' if settings.indexed else ''}: choose code_dim in that range"
            )
        return settings


class ShrunkParameter(NamedTuple):
    """A parameter, what replaced it, and how to cut anything of the old shape to the new one."""

    old: Tensor
    new: Tensor
    cut: Callable[[Tensor], Tensor]


class SemanticField(SemanticEncoder):
    """Decodes rendered codes to raw (not unit length) CLIP features and, if asked for, dense features.

    Codes may be any number: ±inf decode to finite features, NaN to NaN in their own pixel alone. Everything
    is per pixel; decode large maps in chunks.

    Args:
        config: the settings.
        clip_dim: channels of the CLIP features.
        dense_dim: channels of the dense features; 0 leaves the dense head out.
        generator: source of the initial weights.
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
            s.code_dim + s.indexed,
            s.levels,
            s.features_per_level,
            s.log2_table_size,
            s.min_resolution,
            s.max_resolution,
            generator=generator,
        )
        grid_dim = clip_dim if s.indexed else self.grid.output_dim
        fourier_dim = s.code_dim * (1 + 2 * s.fourier_frequencies) if s.fourier_frequencies else 0
        self.hidden = _hidden_layers(grid_dim + fourier_dim, s, generator)
        self.output = _linear(s.hidden_width, clip_dim + dense_dim, generator)

        self.level_weights: Tensor | None
        # All levels are open until `set_progress` says otherwise.
        self.register_buffer("level_weights", torch.ones(s.levels) if s.coarse_to_fine > 0 else None)

    @property
    def bounded(self) -> bool:  # type: ignore[override]
        return self.settings.bounding == "sigmoid"

    def initial_codes(
        self, count: int, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count code"]:
        """Codes to start training from, one per Gaussian; drawn on the generator's device."""
        device = generator.device if generator else None
        noise = torch.randn(count, self.code_dim, generator=generator, device=device)
        return (self.settings.code_std * noise).to(self.output_mean)

    def set_output_statistics(self, mean: Float[Tensor, " out"], std: Float[Tensor, " out"]) -> None:
        """See `SemanticEncoder`; without `whiten` they are ignored."""
        if self.settings.whiten:
            super().set_output_statistics(mean, std)

    def set_progress(self, fraction: float) -> None:
        """Tell how much of the run is done (0 to 1): opens the grid's levels; saved with the checkpoint."""
        if self.level_weights is not None:
            self.level_weights.copy_(self.grid.coarse_to_fine(fraction / self.settings.coarse_to_fine))

    def keep_levels(self, count: int) -> list[ShrunkParameter]:
        """Drop all but the grid's `count` coarsest levels, and what the decoder's first layer reads of them.

        Returns the parameters that were replaced, for the optimiser to follow.
        """
        first = self.hidden[0]
        assert isinstance(first, nn.Linear) and not self.settings.indexed
        columns = first.in_features - (self.grid.levels - count) * self.grid.features_per_level
        table, weight = self.grid.table, first.weight
        self.grid.keep_levels(count)
        entries = self.grid.entries
        first.weight = nn.Parameter(weight.detach()[:, :columns].clone())
        first.in_features = columns
        if self.level_weights is not None:
            self.level_weights = self.level_weights[:count]
        return [
            ShrunkParameter(table, self.grid.table, lambda moment: moment[:entries].clone()),
            ShrunkParameter(weight, first.weight, lambda moment: moment[:, :columns].clone()),
        ]

    def forward(
        self, codes: Float[Tensor, "*batch code"]
    ) -> tuple[Float[Tensor, "*batch clip"], Float[Tensor, "*batch dense"] | None]:
        """CLIP and dense features of every code; dense is None without a dense head."""
        hidden = self._decode_hidden(codes)
        clip = self._head(hidden, slice(0, self.clip_dim))
        dense = self._head(hidden, slice(self.clip_dim, None)) if self.dense_dim else None
        return clip, dense

    def decode_clip(self, codes: Float[Tensor, "*batch code"]) -> Float[Tensor, "*batch clip"]:
        """CLIP features of every code, without computing the dense ones."""
        return self._head(self._decode_hidden(codes), slice(0, self.clip_dim))

    def fit_to_state(self, state: Mapping[str, Tensor]) -> None:
        """Drop the levels that the saved grid has lost."""
        kept = self.grid.levels_in(len(state["grid.table"]))
        if kept is not None and kept < self.grid.levels:
            self.keep_levels(kept)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"field_encoding": self.encoding_parameters(), "field_decoder": self.decoder_parameters()}

    def encoding_parameters(self) -> list[nn.Parameter]:
        """Parameters of the hash grid: an optimiser group without weight decay."""
        return list(self.grid.parameters())

    def decoder_parameters(self) -> list[nn.Parameter]:
        """Parameters of the MLP: a group with weight decay, so that CLIP and dense outputs share edges."""
        return [*self.hidden.parameters(), *self.output.parameters()]

    def _decode_hidden(self, codes: Float[Tensor, "*batch code"]) -> Float[Tensor, "*batch hidden"]:
        coordinates = self._coordinates(codes.reshape(-1, self.code_dim))
        encoding = self._read_grid(coordinates)
        if self.settings.fourier_frequencies:
            encoding = torch.cat((self._fourier(coordinates), encoding), 1)
        return self.hidden(encoding).reshape(*codes.shape[:-1], self.settings.hidden_width)

    def _coordinates(self, codes: Float[Tensor, "n code"]) -> Float[Tensor, "n code"]:
        if self.settings.bounding == "sigmoid":
            return codes.sigmoid()
        return codes.clamp(-COORDINATE_LIMIT, COORDINATE_LIMIT)

    def _read_grid(self, coordinates: Float[Tensor, "n code"]) -> Float[Tensor, "n channels"]:
        if not self.settings.indexed:
            return self.grid(coordinates, self.level_weights)
        passes = math.ceil(self.clip_dim / self.grid.output_dim)
        index = torch.arange(passes, device=coordinates.device, dtype=coordinates.dtype) / passes
        index = index.expand(len(coordinates), -1)[..., None]
        points = torch.cat((index, coordinates[:, None].expand(-1, passes, -1)), 2)
        features = self.grid(points.flatten(0, 1), self.level_weights)
        return features.reshape(len(coordinates), passes * self.grid.output_dim)[:, : self.clip_dim]

    def _fourier(self, coordinates: Float[Tensor, "n code"]) -> Float[Tensor, "n features"]:
        octaves = 2.0 ** torch.arange(self.settings.fourier_frequencies, device=coordinates.device)
        angles = (coordinates[..., None] * (2 * math.pi * octaves.to(coordinates))).flatten(1)
        return torch.cat((coordinates, angles.sin(), angles.cos()), 1)

    def _head(self, hidden: Tensor, channels: slice) -> Tensor:
        # Whitening is folded into the layer: scaling its few weights is cheaper than scaling a feature map.
        std = self.output_std[channels]
        weight = self.output.weight[channels] * std[:, None]
        return F.linear(hidden, weight, self.output.bias[channels] * std + self.output_mean[channels])


def _hidden_layers(inputs: int, settings: FieldSettings, generator: torch.Generator | None) -> nn.Sequential:
    layers: list[nn.Module] = []
    for depth in range(settings.hidden_layers):
        layers.append(
            _linear(inputs if depth == 0 else settings.hidden_width, settings.hidden_width, generator)
        )
        if settings.activation == "every" or depth == settings.hidden_layers - 1:
            layers.append(nn.ReLU())
    return nn.Sequential(*layers)


def _linear(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Linear:
    """A linear layer with torch's customary initial range, drawn from the given generator."""
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs)
    for parameter in layer.parameters():
        nn.init.uniform_(parameter, -(inputs**-0.5), inputs**-0.5, generator=generator)
    return layer
