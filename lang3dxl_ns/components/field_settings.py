"""Settings of the semantic field, and of the compression of features to its codes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.components.hash_grid import MOST_DIMENSIONS

Preset = Literal["short", "paper", "official"]
_MOST_GROWTH = 3
"""Largest factor of steps and sample; more takes longer and hardly improves the features (docs/scale.md)."""
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


@dataclass
class CompressionConfig:
    """Settings of the compression of features to codes."""

    steps: int = 1_000
    """Number of training steps. Scenes with many Gaussians take up to three times as many."""
    batch: int = 3_072
    """Number of Gaussians per step."""
    sample: int = 16_384
    """Number of Gaussians that the field is trained on. Scenes with many take up to three times as many."""
    code_rate: float = 2e-2
    """Adam's learning rate for the codes."""
    field_rate: float = 1e-2
    """Adam's learning rate for the field."""

    def grown(self, count: int) -> CompressionConfig:
        """Multiply steps and sample for `count` Gaussians by √(count / sample), rounded, in 1…3. A field that
        has seen few of many Gaussians matches those few, and the others less."""
        factor = min(max(round(math.sqrt(count / self.sample)), 1), _MOST_GROWTH)
        return replace(self, steps=factor * self.steps, sample=factor * self.sample)
