"""Compression of per-Gaussian features to a few numbers each, decoded by a semantic field.

A direct regression, without rendering. Each Gaussian is decoded before compositing, so codes of neighbors
never blend into a third one with another meaning.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.components.semantic_field import SemanticField, SemanticFieldConfig

_LEAST_MASS = 1.0
"""Pixels, over all photos, that a Gaussian needs to take part in choosing the initial axes of the codes."""
_REACH = 3.0
"""Initial codes lie within this many standard deviations."""


@dataclass
class CompressionConfig:
    """Settings of the regression."""

    steps: int = 1_000
    """Number of steps."""
    batch: int = 3_072
    """Gaussians per step."""
    code_rate: float = 2e-2
    """Adam's learning rate for the codes."""
    field_rate: float = 1e-2
    """Adam's learning rate for the field."""


def compress(
    features: Float[Tensor, "n c"],
    mass: Float[Tensor, " n"],
    field: SemanticField,
    config: CompressionConfig | None = None,
    generator: torch.Generator | None = None,
    advance: Callable[[], None] = lambda: None,
    basis: PrincipalBasis | None = None,
) -> Float[Tensor, "n code"]:
    """Codes that the field, trained along with them, decodes to these features; on the field's device.

    Gaussians without mass, visible in no photo, get NaN codes: unknown. The loss is the mean absolute
    difference over Gaussians sampled with probability √mass, so that small things count beside walls.

    Args:
        features: CLIP features of each Gaussian, of any length, or their coordinates in `basis`; they and
            `mass` may lie on the CPU, whatever the field's device is.
        mass: pixels that each Gaussian fills, weighted; not negative.
        field: a field without dense features, in its initial state; trained in place.
        generator: source of the batches, on the CPU.
        advance: called after each step.
    """
    config = config or CompressionConfig()
    seen, place = mass > 0, field.output_mean
    codes = place.new_full((len(features), field.code_dim), torch.nan)
    if not seen.any():
        return codes
    known, weight = features[seen], mass[seen]
    basis = None if basis is None else basis.to(place)
    field.set_output_statistics(*_statistics(known, weight.sqrt(), basis))
    learned = nn.Parameter(_principal_codes(known, weight, field.code_dim).to(place))
    _fit(known, weight.sqrt(), learned, field, config, generator, advance, basis)
    codes[seen.to(codes.device)] = learned.detach()
    return codes


def _fit(
    features: Float[Tensor, "n c"],
    weight: Float[Tensor, " n"],
    codes: nn.Parameter,
    field: SemanticField,
    config: CompressionConfig,
    generator: torch.Generator | None,
    advance: Callable[[], None],
    basis: PrincipalBasis | None,
) -> None:
    groups = [
        {"params": [codes], "lr": config.code_rate},
        {"params": list(field.parameters()), "lr": config.field_rate},
    ]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps, eta_min=0.0)
    chances = weight.cpu().double().cumsum(0)
    field.set_progress(1.0)
    with torch.enable_grad():
        for _ in range(config.steps):
            draws = torch.rand(config.batch, generator=generator, dtype=torch.float64) * chances[-1]
            rows = torch.searchsorted(chances, draws).clamp_max(len(chances) - 1)
            wanted = to_device(features[rows.to(features.device)], codes.device)
            if basis is not None:
                wanted = basis.features(wanted)
            loss = (field.decode_clip(codes[rows.to(codes.device)]) - wanted).abs().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            advance()


def _statistics(
    features: Float[Tensor, "n c"], weight: Float[Tensor, " n"], basis: PrincipalBasis | None
) -> tuple[Float[Tensor, " clip"], Float[Tensor, " clip"]]:
    """Weighted mean and standard deviation per channel of CLIP, the latter at least 1 % of their average."""
    share = (weight / weight.sum())[:, None]
    mean = (share * features).sum(0)
    if basis is None:
        variance = (share * (features - mean).square()).sum(0)
    else:
        covariance = ((share * (features - mean)).T @ (features - mean)).to(basis.axes)
        variance = ((basis.axes @ covariance) * basis.axes).sum(1).clamp_min(0)
        mean = basis.features(mean.to(basis.mean))
    std = variance.sqrt()
    return mean, std.clamp_min(float(0.01 * std.mean()))


def _principal_codes(
    features: Float[Tensor, "n c"], mass: Float[Tensor, " n"], code_dim: int
) -> Float[Tensor, "n code"]:
    """The first principal components of the features, each divided by its deviation."""
    chosen = mass >= _LEAST_MASS
    sample = features[chosen] if int(chosen.sum()) > code_dim else features
    mean = sample.mean(0)
    covariance = (sample - mean).T @ (sample - mean) / len(sample)
    values, axes = torch.linalg.eigh(covariance.double())
    places = (features - mean) @ axes[:, -code_dim:].flip(1).to(features)
    deviation = values[-code_dim:].flip(0).clamp_min(0).sqrt().to(features)
    return (places / deviation.clamp_min(1e-12)).clamp(-_REACH, _REACH)


class CompressedField(SemanticField):
    """The semantic field of a scene whose features are gathered onto its Gaussians after training: it
    decodes each Gaussian's code, before compositing. Until then there are no codes."""

    per_gaussian = True
    needs_lifting = True
    gathered_channels = 128

    def __init__(
        self, config: SemanticFieldConfig, clip_dim: int, compression: CompressionConfig | None = None
    ) -> None:
        super().__init__(config, clip_dim)
        self.config, self.compression = config, compression or CompressionConfig()

    @property
    def learning_steps(self) -> int:  # type: ignore[override]
        return self.compression.steps

    def initial_codes(self, count: int, generator: torch.Generator | None = None) -> None:  # type: ignore[override]
        return None

    def carried(self, gaussians: Mapping[str, Tensor]) -> Float[Tensor, "n code"] | None:
        return gaussians.get("codes")

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {}

    def learn_gaussians(
        self,
        features: Float[Tensor, "n clip"],
        mass: Float[Tensor, " n"],
        advance: Callable[[], None] = lambda: None,
        basis: PrincipalBasis | None = None,
    ) -> Float[Tensor, "n code"]:
        generator = torch.Generator().manual_seed(0)
        fresh = SemanticField(self.config, self.clip_dim, generator=generator).to(self.output_mean.device)
        codes = compress(features, mass, fresh, self.compression, generator, advance, basis)
        self.load_state_dict(fresh.state_dict())
        return codes
