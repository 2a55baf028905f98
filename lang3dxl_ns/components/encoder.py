"""What Gaussians carry of the semantics, what of it is rendered, and how a rendered map becomes features."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn


class SemanticEncoder(nn.Module, ABC):
    """The interface of the semantic field and of the encoders that it is compared with.

    The model gives every Gaussian `initial_codes`, renders what is `carried`, and calls the encoder on the
    rendered map. Outputs are raw (not unit length) CLIP features and, if asked for, dense features.

    Args:
        clip_dim: channels of the CLIP features.
        dense_dim: channels of the dense features; 0 for none.
    """

    def __init__(self, clip_dim: int, dense_dim: int) -> None:
        super().__init__()
        self.clip_dim, self.dense_dim = clip_dim, dense_dim
        self.output_mean: Tensor
        self.output_std: Tensor
        self.register_buffer("output_mean", torch.zeros(clip_dim + dense_dim))
        self.register_buffer("output_std", torch.ones(clip_dim + dense_dim))

    bounded = False
    """Whether codes are squashed by a sigmoid before they are decoded."""
    needs_lifting = False
    """Whether the codes are computed from the photos when training ends, and not learned."""

    @abstractmethod
    def initial_codes(
        self, count: int, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count code"] | None:
        """Codes to start training from, one per Gaussian; None where Gaussians learn none."""

    def carried(self, gaussians: Mapping[str, Tensor]) -> Float[Tensor, "n d"] | None:
        """What is rendered, from the Gaussians' raw parameters; None for nothing (yet)."""
        return gaussians["codes"]

    @abstractmethod
    def forward(
        self, rendered: Float[Tensor, "*batch d"]
    ) -> tuple[Float[Tensor, "*batch clip"], Float[Tensor, "*batch dense"] | None]:
        """CLIP and dense features of every pixel; dense is None without a dense head."""

    def decode_clip(self, rendered: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch clip"]:
        """CLIP features of every pixel."""
        return self(rendered)[0]

    def picture(self, rendered: Float[Tensor, "h w d"]) -> Float[Tensor, "h w 3"]:
        """The first three channels as colours in [0, 1]."""
        colours = rendered[..., :3].sigmoid()
        return torch.cat([colours, colours[..., :1].expand(-1, -1, 3 - colours.shape[-1])], dim=-1)

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Optimiser groups by name."""

    def own_losses(
        self, clip: Float[Tensor, "h w clip"], dense: Float[Tensor, "h w dense"] | None
    ) -> dict[str, Float[Tensor, ""]]:
        """Losses that belong to the encoder, already weighted, of a decoded map."""
        return {}

    def learn_targets(self, targets: Callable[[], Iterable[Float[Tensor, "h w clip"]]]) -> None:
        """Before training: whatever has to be known of the photos' CLIP targets."""

    def set_output_statistics(self, mean: Float[Tensor, " out"], std: Float[Tensor, " out"]) -> None:
        """Per-channel mean and deviation of the targets, CLIP then dense.

        Raises:
            ValueError: wrong number of channels, or a value that is not finite, or a negative deviation.
        """
        if mean.shape != self.output_mean.shape or std.shape != self.output_std.shape:
            raise ValueError(
                f"output statistics need {len(self.output_mean)} channels (CLIP {self.clip_dim}, dense "
                f"{self.dense_dim}), got mean {tuple(mean.shape)} and std {tuple(std.shape)}"
            )
        if not (mean.isfinite().all() and std.isfinite().all() and (std >= 0).all()):
            raise ValueError("output statistics must be finite and the deviations not negative")
        self.output_mean.copy_(mean)
        self.output_std.copy_(std)

    def set_progress(self, fraction: float) -> None:
        """Tell how much of the run is done (0 to 1)."""

    def fit_to_state(self, state: Mapping[str, Tensor]) -> None:
        """Take the shape of saved tensors (names without prefix), where that has changed in training."""

    def _split(
        self, features: Float[Tensor, "*batch out"]
    ) -> tuple[Float[Tensor, "*batch clip"], Float[Tensor, "*batch dense"] | None]:
        return features[..., : self.clip_dim], features[..., self.clip_dim :] if self.dense_dim else None
