"""Feature decoder interface: values that Gaussians carry, and how their renderings become features."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig
from lang3dxl_ns.components.principal_basis import PrincipalBasis

Features = tuple[Float[Tensor, "*batch clip"], Float[Tensor, "*batch dense"] | None]
"""CLIP features, and dense features if there is a dense head."""


@dataclass(frozen=True)
class Gathered:
    """Features gathered onto Gaussians."""

    features: Float[Tensor, "n c"]
    """CLIP features, or their coordinates in `basis`."""
    mass: Float[Tensor, " n"]
    """Pixels that each Gaussian fills; 0 for those that no photo shows."""
    basis: PrincipalBasis | None = None

    def __len__(self) -> int:
        return len(self.mass)

    def __getitem__(self, rows: Bool[Tensor, " n"] | Int[Tensor, " m"]) -> Gathered:
        return Gathered(self.features[rows], self.mass[rows], self.basis)


class Decoder(nn.Module, ABC):
    """Interface of the semantic field and of other ways to store features on Gaussians.

    The model gives every Gaussian `initial_codes`, renders `carried` values, and decodes the rendered map.
    Outputs are raw (not unit length) CLIP features of `clip_dim` channels and, unless `dense_dim` is 0, dense
    features of that many.
    """

    def __init__(self, clip_dim: int, dense_dim: int) -> None:
        super().__init__()
        self.clip_dim, self.dense_dim = clip_dim, dense_dim
        self.output_mean: Tensor
        self.output_std: Tensor
        self.register_buffer("output_mean", torch.zeros(clip_dim + dense_dim))
        self.register_buffer("output_std", torch.ones(clip_dim + dense_dim))

    @classmethod
    def build(
        cls, settings: SemanticFieldConfig, clip_dim: int, compression: CompressionConfig, dense_dim: int
    ) -> Decoder:
        """Build a decoder for a run. settings, compression: the run's, for decoders with a semantic field."""
        return cls(clip_dim, dense_dim)

    name = ""
    """Name of the decoder in `decoders.DECODERS`."""
    settings: SemanticFieldConfig | None = None
    """Settings of the decoder's semantic field; None if it has none."""
    code_dim: int | None = None
    """Channels of a code; None if any number will do."""
    bounded = False
    """Whether codes are squashed by a sigmoid before they are decoded."""
    per_gaussian = False
    """Whether carried values are decoded per Gaussian before compositing, or per pixel after it."""
    needs_lifting = False
    """Whether the codes are computed from the photos after training instead of learned."""

    def initial_codes(self, count: int) -> Float[Tensor, "count code"] | None:
        """Return initial codes, one per Gaussian; None if Gaussians learn none."""
        return None

    def carried(self, gaussians: Mapping[str, Tensor] | nn.ParameterDict) -> Float[Tensor, "n d"] | None:
        """Return the values to render, from the Gaussians' raw parameters; None if there are none (yet)."""
        return gaussians.get("codes")

    @abstractmethod
    def forward(self, rendered: Float[Tensor, "*batch d"]) -> Features:
        """Decode the CLIP and dense features of every pixel."""

    def decode_clip(self, rendered: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch clip"]:
        """Decode the CLIP features of every pixel."""
        return self(rendered)[0]

    def hidden(self, carried: Float[Tensor, "n d"]) -> Float[Tensor, "n r"]:
        """Compute the input of the last layer, `clip_head`, which outputs CLIP features."""
        return self.decode_clip(carried)

    def clip_head(self) -> tuple[Float[Tensor, "clip r"], Float[Tensor, " clip"]] | None:
        """Return weight and bias of `decode_clip`'s linear last layer; None if `hidden` is the feature."""
        return None

    def picture(self, carried: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch 3"]:
        """Convert the first three channels to colors in [0, 1]."""
        colors = carried[..., :3].sigmoid()
        missing = 3 - colors.shape[-1]
        return torch.cat([colors, *[colors[..., :1]] * missing], dim=-1)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters by optimizer group; none by default."""
        return {}

    def own_losses(
        self, clip: Float[Tensor, "h w clip"], dense: Float[Tensor, "h w dense"] | None
    ) -> dict[str, Float[Tensor, ""]]:
        """Compute the decoder's own losses on a decoded map, already weighted."""
        return {}

    def set_extent(self, center: Float[Tensor, "3"], radius: float) -> None:
        """Set the scene's center and radius in world units, for decoders of places."""

    def learn_targets(self, targets: Callable[[], Iterable[Float[Tensor, "h w clip"]]]) -> None:
        """Learn from the photos' CLIP targets. The model calls this before training."""

    def set_output_statistics(self, mean: Float[Tensor, " out"], std: Float[Tensor, " out"]) -> None:
        """Set the per-channel mean and deviation of the targets, CLIP then dense. Raises ValueError for a
        wrong number of channels, a non-finite value, or a negative deviation."""
        if mean.shape != self.output_mean.shape or std.shape != self.output_std.shape:
            raise ValueError(
                f"output statistics need {len(self.output_mean)} channels (CLIP {self.clip_dim}, dense "
                f"{self.dense_dim}), got mean {tuple(mean.shape)} and std {tuple(std.shape)}"
            )
        if not (mean.isfinite().all() and std.isfinite().all() and (std >= 0).all()):
            raise ValueError("output statistics must be finite and the deviations not negative")
        self.output_mean.copy_(mean)
        self.output_std.copy_(std)


class LearningDecoder(Decoder):
    """Interface of decoders that learn codes of finished Gaussians, from features gathered onto them."""

    gathered_channels: int | None = None
    """Number of principal components to gather if CLIP features are wider; None gathers the features."""
    learned: str | None = None
    """Result of `learn_gaussians` in a sentence, for the log; None if there is nothing to report."""

    @abstractmethod
    def learn_gaussians(
        self, gathered: Gathered, advance: Callable[[], None] = lambda: None
    ) -> Float[Tensor, "n code"]:
        """Learn codes for features gathered onto the Gaussians, and call `advance` `learning_steps` times."""

    def learning_steps(self, count: int) -> int:
        """Return the number of steps of `learn_gaussians` for `count` Gaussians."""
        return 0

    def learning_seconds(self, count: int) -> float:
        """Estimate the seconds that `learn_gaussians` takes for `count` Gaussians on one core."""
        return 0.0
