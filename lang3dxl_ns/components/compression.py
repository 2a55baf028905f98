"""Compression of per-Gaussian features to a few numbers each, decoded by a semantic field.

The field and the codes of a sample of the Gaussians are found by direct regression, without rendering. Then
every Gaussian gets the code that decodes nearest to its feature. Each is decoded before compositing, so codes
of neighbors never blend into a third one with another meaning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.components.code_search import nearest, settle
from lang3dxl_ns.components.feature_decoder import Gathered, LearningDecoder
from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig
from lang3dxl_ns.components.hash_grid import MOST_DIMENSIONS
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.components.semantic_field import SemanticField

GOOD = 0.95
"""Mean centered cosine below which codes get more numbers."""
CODE_DIMS = (3, 4, 6)
"""Numbers per code that are tried in turn, unless the settings fix one."""
_LEAST_MASS = 1.0
"""Pixels, over all photos, that a Gaussian needs to take part in choosing the initial axes of the codes."""
_REACH = 3.0
"""Largest initial code, in standard deviations."""
_ROWS = 16_384
"""Number of Gaussians processed at a time, to bound memory."""
_SECONDS_PER_DRAW, _SECONDS_PER_GAUSSIAN = 1e-5, 1e-4
"""Time on one core per Gaussian drawn in a step and per Gaussian searched, for the announced duration."""
_BLENDS = 0.9
"""Fraction of blends among the draws where codes are composited before they are decoded, as in the paper."""
_SEARCHES = (0.4, 0.6, 0.8)
"""Fractions of the steps after which the sample's codes are searched anew, because descent alone leaves some
of them in the wrong place."""


def seen_by_photos(gathered: Gathered) -> Gathered:
    """Select the Gaussians with mass, which are those that some photo shows."""
    seen = gathered.mass > 0
    return gathered if seen.all() else gathered[seen]


def draw_sample(gathered: Gathered, size: int, generator: torch.Generator | None) -> Gathered:
    """Draw `size` Gaussians by √mass, so that small things count beside walls; keep all if fewer."""
    if len(gathered) <= size:
        return gathered
    # The largest of log(u) / w is drawn with probability ∝ w (Efraimidis & Spirakis 2006).
    uniform = torch.rand(len(gathered), generator=generator, dtype=torch.float64).to(gathered.mass.device)
    return gathered[(uniform.log() / gathered.mass.double().sqrt()).topk(size).indices.sort().values]


def _rows(features: Float[Tensor, "n c"], rows: Tensor, like: Tensor) -> Float[Tensor, "m c"]:
    """Return the features of some Gaussians, on the device of `like`."""
    return to_device(features[rows.to(features.device)], like.device)


def fit(
    sample: Gathered,
    field: SemanticField,
    config: CompressionConfig,
    generator: torch.Generator | None = None,
    advance: Callable[[], None] = lambda: None,
    blends: float = 0.0,
) -> Float[Tensor, "m code"]:
    """Train the field (in place) and the codes of these Gaussians together, and return the codes.

    The loss is the mean absolute difference over Gaussians that `generator` draws with probability ∝ √mass.
    `advance` is called after every step. `blends` is the fraction of the draws that are replaced by blends of
    two Gaussians, whose codes decode to the same blend of their features. Codes are then not searched anew,
    which would scatter them.
    """
    place = field.output_mean
    if not len(sample):
        return place.new_empty(0, field.code_dim)
    basis, weight = None if sample.basis is None else sample.basis.to(place), sample.mass.sqrt()
    if not field.dense_dim:  # otherwise it already has statistics of its CLIP and dense targets
        field.set_output_statistics(*_statistics(sample.features, weight, basis))
    codes = nn.Parameter(_principal_codes(sample.features, sample.mass, field.code_dim).to(place))
    groups = [
        {"params": [codes], "lr": config.code_rate},
        {"params": list(field.parameters()), "lr": config.field_rate},
    ]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps, eta_min=0.0)
    chances = weight.cpu().double().cumsum(0)
    searches = set() if blends else {round(share * config.steps) for share in _SEARCHES}

    def draw() -> Int[Tensor, " batch"]:
        place = torch.rand(config.batch, generator=generator, dtype=torch.float64) * chances[-1]
        return torch.searchsorted(chances, place).clamp_max(len(chances) - 1)

    with torch.enable_grad():
        for step in range(config.steps):
            if step in searches and step:
                codes.data.copy_(_search(sample, field, codes.data))
            rows = draw()
            wanted, used = _rows(sample.features, rows, codes), codes[rows.to(codes.device)]
            if blends:
                other, (part, mixed) = draw(), torch.rand(2, config.batch, 1, generator=generator)
                part = (part * (mixed < blends)).to(codes)
                used = used.lerp(codes[other.to(codes.device)], part)
                wanted = wanted.lerp(_rows(sample.features, other, codes), part)
            if basis is not None:
                wanted = basis.features(wanted)
            loss = (field.decode_clip(used) - wanted).abs().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            advance()
    optimizer.zero_grad()  # training may continue with this field
    return codes.detach()


@torch.no_grad()
def _search(
    gathered: Gathered, field: SemanticField, codes: Float[Tensor, "m code"]
) -> Float[Tensor, "n code"]:
    """Find the code that decodes nearest to each Gaussian's feature: the best of `codes`, then refined."""
    head = _head(field, gathered.basis)
    parts = (to_device(part, codes.device) for part in gathered.features.split(_ROWS))
    return torch.cat([settle(field, head, nearest(field, head, codes, part), part) for part in parts])


def _head(
    field: SemanticField, basis: PrincipalBasis | None
) -> tuple[Float[Tensor, "c hidden"], Float[Tensor, " c"]]:
    """Return the field's last layer, with outputs in the coordinates of the basis."""
    weight, bias = field.clip_head()
    if basis is None:
        return weight, bias
    basis = basis.to(weight)
    return basis.axes.T @ weight, basis.coordinates(bias)


def assign(
    gathered: Gathered, field: SemanticField, known: Float[Tensor, "m code"]
) -> Float[Tensor, "n code"]:
    """Find a code for every Gaussian with mass, starting from the codes of a sample; NaN for the others."""
    codes = known.new_full((len(gathered), field.code_dim), torch.nan)
    if len(known):
        for rows in (gathered.mass > 0).nonzero()[:, 0].split(_ROWS):
            codes[rows.to(codes.device)] = _search(gathered[rows], field, known)
    return codes


@torch.no_grad()
def centered_cosine(gathered: Gathered, field: SemanticField, codes: Float[Tensor, "n code"]) -> float:
    """Compute the mean cosine of decoded and given features, both less the mean feature.

    It is 1 if nothing is lost. Without centering, even the mean feature has a cosine above 0.9 with all."""
    features = gathered.features
    if not len(features):
        return 1.0
    (weight, bias), mean, total = _head(field, gathered.basis), features.mean(0).to(codes), 0.0
    for rows in torch.arange(len(features)).split(_ROWS):
        decoded = F.linear(field.hidden(codes[rows.to(codes.device)]), weight, bias)
        wanted = _rows(features, rows, codes)
        total += float(F.cosine_similarity(decoded - mean, wanted - mean, dim=1).sum())
    return total / len(features)


def _statistics(
    features: Float[Tensor, "n c"], weight: Float[Tensor, " n"], basis: PrincipalBasis | None
) -> tuple[Float[Tensor, " clip"], Float[Tensor, " clip"]]:
    """Compute weighted mean and deviation per CLIP channel; deviations are at least 1 % of their average."""
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
    """Compute the first principal components of the features, each divided by its deviation."""
    chosen = mass >= _LEAST_MASS
    sample = features[chosen] if int(chosen.sum()) > code_dim else features
    mean = sample.mean(0)
    covariance = (sample - mean).T @ (sample - mean) / len(sample)
    values, axes = torch.linalg.eigh(covariance.double())
    places = (features - mean) @ axes[:, -code_dim:].flip(1).to(features)
    deviation = values[-code_dim:].flip(0).clamp_min(0).sqrt().to(features)
    return (places / deviation.clamp_min(1e-12)).clamp(-_REACH, _REACH)


class _LearningField(SemanticField, LearningDecoder):
    """Semantic field that can learn codes of features gathered onto Gaussians."""

    gathered_channels = 128

    def __init__(
        self,
        config: SemanticFieldConfig,
        clip_dim: int,
        compression: CompressionConfig | None = None,
        dense_dim: int = 0,
    ) -> None:
        super().__init__(config, clip_dim, dense_dim)
        self.config, self.compression = config, compression or CompressionConfig()

    @classmethod
    def build(
        cls, settings: SemanticFieldConfig, clip_dim: int, compression: CompressionConfig, dense_dim: int
    ) -> SemanticField:
        return cls(settings, clip_dim, compression, dense_dim)

    def learning_steps(self, count: int) -> int:
        return self.compression.grown(count).steps

    def learning_seconds(self, count: int) -> float:
        draws = self.learning_steps(count) * self.compression.batch
        return draws * _SECONDS_PER_DRAW + count * _SECONDS_PER_GAUSSIAN

    def _drawn(self, gathered: Gathered) -> tuple[CompressionConfig, Gathered, torch.Generator]:
        generator, config = torch.Generator().manual_seed(0), self.compression.grown(len(gathered))
        return config, draw_sample(seen_by_photos(gathered), config.sample, generator), generator


class CompressedField(_LearningField):
    """Semantic field of a scene whose features are gathered onto its Gaussians after training. It decodes
    each Gaussian's code before compositing. During training there are no codes."""

    per_gaussian = True
    needs_lifting = True

    def initial_codes(self, count: int) -> None:  # type: ignore[override]
        return None

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {}

    def learn_gaussians(
        self, gathered: Gathered, advance: Callable[[], None] = lambda: None
    ) -> Float[Tensor, "n code"]:
        """Learn codes of three numbers, or of more if three lose too much and the settings allow it."""
        config, sample, generator = self._drawn(gathered)
        state = generator.get_state()
        dims = CODE_DIMS if self.config.code_dim is None else (self.config.code_dim,)
        lost = ""
        for dim in dims:
            generator.set_state(state)
            fresh = SemanticField(replace(self.config, code_dim=dim), self.clip_dim, generator=generator)
            fresh = fresh.to(self.output_mean.device)
            codes = fit(sample, fresh, config, generator, advance if dim == dims[0] else lambda: None)
            found = assign(sample, fresh, codes)
            cosine = centered_cosine(sample, fresh, found)
            if cosine >= GOOD or dim == dims[-1]:
                break
            lost += f"; {dim} numbers: {cosine:.3f}"
        self.take(fresh)
        codes = assign(gathered, self, found)
        known = (gathered.mass > 0).to(codes.device)
        cosine = centered_cosine(seen_by_photos(gathered), self, codes[known])
        self.learned = (
            f"features compressed to {self.code_dim} numbers per Gaussian: centered cosine {cosine:.3f}{lost}"
        )
        return codes

    def take(self, other: SemanticField) -> None:
        """Take over the weights and settings of another field, whose codes may have another length."""
        self.settings, self.code_dim = other.settings, other.code_dim
        self.grid, self.layers, self.output = other.grid, other.layers, other.output
        self.set_output_statistics(other.output_mean, other.output_std)

    def fit_codes(self, codes: Float[Tensor, "n code"]) -> None:
        """Resize the field to the length of these codes, so that the weights of their field can be loaded."""
        wide = codes.shape[1] if codes.dim() == 2 else 0
        if wide != self.code_dim and 2 <= wide <= MOST_DIMENSIONS:
            self.take(SemanticField(replace(self.config, code_dim=codes.shape[1]), self.clip_dim))


class JointField(_LearningField):
    """Semantic field whose codes are trained with the scene, and may start from gathered features."""

    def learn_gaussians(
        self, gathered: Gathered, advance: Callable[[], None] = lambda: None
    ) -> Float[Tensor, "n code"]:
        """Learn codes from which training continues, and train the field to decode them."""
        config, sample, generator = self._drawn(gathered)
        return assign(gathered, self, fit(sample, self, config, generator, advance, _BLENDS))
