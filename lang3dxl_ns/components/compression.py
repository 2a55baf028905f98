"""Compression of per-Gaussian features to a few numbers each, decoded by a semantic field.

A direct regression, without rendering. Each Gaussian is decoded before compositing, so codes of neighbors
never blend into a third one with another meaning.

The field is trained on a sample of the Gaussians; then every Gaussian gets the code that decodes nearest to
its feature, so that the work beyond the sample is one search per Gaussian.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import count

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.components.code_search import nearest, settle
from lang3dxl_ns.components.hash_grid import MOST_DIMENSIONS
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.components.semantic_field import SemanticField, SemanticFieldConfig

GOOD = 0.95
"""Mean centered cosine below which codes get more numbers."""
CODE_DIMS = (3, 4, 6)
"""Numbers per code, tried in turn unless the settings say how many."""
_LEAST_MASS = 1.0
"""Pixels, over all photos, that a Gaussian needs to take part in choosing the initial axes of the codes."""
_REACH = 3.0
"""Initial codes lie within this many standard deviations."""
_ROWS = 16_384
"""Gaussians at a time, to bound memory."""
_SECONDS_PER_DRAW, _SECONDS_PER_GAUSSIAN = 1e-5, 1e-4
"""Of one core, to announce how long it will take."""
_MOST_GROWTH = 3
"""Beyond, time grows and the features hardly come nearer (docs/scale.md)."""
_SEARCHES = (0.4, 0.6, 0.8)
"""Fractions of the steps after which the sample's codes are searched anew: descent alone leaves some of them
in the wrong place for good."""


@dataclass
class CompressionConfig:
    """Settings of the regression."""

    steps: int = 1_000
    """Number of steps, up to three times as many for many Gaussians."""
    batch: int = 3_072
    """Gaussians per step."""
    sample: int = 16_384
    """Gaussians that the field is trained on, if there are more; up to three times as many."""
    code_rate: float = 2e-2
    """Adam's learning rate for the codes."""
    field_rate: float = 1e-2
    """Adam's learning rate for the field."""

    def growth(self, count: int) -> int:
        """Factor of steps and sample for so many Gaussians: the root of their number in samples, at most 3.
        A field that has seen few of many fits those few, and the others less."""
        return min(max(round(math.sqrt(count / self.sample)), 1), _MOST_GROWTH)

    def grown(self, count: int) -> CompressionConfig:
        """The settings for so many Gaussians."""
        factor = self.growth(count)
        return replace(self, steps=factor * self.steps, sample=factor * self.sample)


@dataclass(frozen=True)
class Gathered:
    """Features gathered onto Gaussians, all of them with mass."""

    features: Float[Tensor, "n c"]
    mass: Float[Tensor, " n"]
    basis: PrincipalBasis | None
    """What the features are coordinates in; None: they are features of CLIP themselves."""

    def rows(self, rows: Int[Tensor, " m"], like: Tensor) -> Float[Tensor, "m c"]:
        """Features of some Gaussians, on a device."""
        return to_device(self.features[rows.to(self.features.device)], like.device)

    def sample(self, size: int, generator: torch.Generator | None) -> Gathered:
        """Gaussians drawn by √mass, so that small things count beside walls; all if they are no more."""
        if len(self.mass) <= size:
            return self
        # The largest of log(u) / w is drawn with probability ∝ w (Efraimidis & Spirakis 2006).
        uniform = torch.rand(len(self.mass), generator=generator, dtype=torch.float64).to(self.mass.device)
        rows = (uniform.log() / self.mass.double().sqrt()).topk(size).indices.sort().values
        return Gathered(self.features[rows], self.mass[rows], self.basis)


def seen_by_photos(
    features: Float[Tensor, "n c"], mass: Float[Tensor, " n"], basis: PrincipalBasis | None
) -> Gathered:
    """The Gaussians with mass, which some photo shows."""
    seen = mass > 0
    return Gathered(features, mass, basis) if seen.all() else Gathered(features[seen], mass[seen], basis)


def fit(
    sample: Gathered,
    field: SemanticField,
    config: CompressionConfig,
    generator: torch.Generator | None = None,
    advance: Callable[[], None] = lambda: None,
) -> Float[Tensor, "m code"]:
    """Train the field and codes of these Gaussians together. The loss is the mean absolute difference over
    Gaussians drawn with probability √mass."""
    place = field.output_mean
    if not len(sample.mass):
        return place.new_empty(0, field.code_dim)
    basis, weight = None if sample.basis is None else sample.basis.to(place), sample.mass.sqrt()
    if not field.dense_dim:  # otherwise it knows those of its targets, dense features among them
        field.set_output_statistics(*_statistics(sample.features, weight, basis))
    codes = nn.Parameter(_principal_codes(sample.features, sample.mass, field.code_dim).to(place))
    groups = [
        {"params": [codes], "lr": config.code_rate},
        {"params": list(field.parameters()), "lr": config.field_rate},
    ]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps, eta_min=0.0)
    chances = weight.cpu().double().cumsum(0)
    searches = {round(share * config.steps) for share in _SEARCHES}
    field.set_progress(1.0)
    with torch.enable_grad():
        for step in range(config.steps):
            if step in searches and step:
                codes.data.copy_(_search(sample, field, codes.data, basis))
            draws = torch.rand(config.batch, generator=generator, dtype=torch.float64) * chances[-1]
            rows = torch.searchsorted(chances, draws).clamp_max(len(chances) - 1)
            wanted = sample.rows(rows, codes)
            if basis is not None:
                wanted = basis.features(wanted)
            loss = (field.decode_clip(codes[rows.to(codes.device)]) - wanted).abs().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            advance()
    optimizer.zero_grad()  # training may go on with this field
    return codes.detach()


@torch.no_grad()
def _search(
    gathered: Gathered, field: SemanticField, codes: Float[Tensor, "m code"], basis: PrincipalBasis | None
) -> Float[Tensor, "n code"]:
    """For every Gaussian the code that decodes nearest to its feature: the best of `codes`, moved on."""
    head = _head(field, basis)
    found = [
        settle(field, head, nearest(field, head, codes, part), part)
        for rows in torch.arange(len(gathered.mass)).split(_ROWS)
        for part in [gathered.rows(rows, codes)]
    ]
    return torch.cat(found)


def _head(
    field: SemanticField, basis: PrincipalBasis | None
) -> tuple[Float[Tensor, "c hidden"], Float[Tensor, " c"]]:
    """The field's last layer, into the coordinates of the basis."""
    weight, bias = field.clip_head()
    return (weight, bias) if basis is None else (basis.axes.T @ weight, basis.coordinates(bias))


def assign(
    features: Float[Tensor, "n c"],
    mass: Float[Tensor, " n"],
    field: SemanticField,
    known: Float[Tensor, "m code"],
    basis: PrincipalBasis | None = None,
) -> Float[Tensor, "n code"]:
    """A code for every Gaussian with mass, NaN for the others. known: codes of a sample of the Gaussians."""
    codes = known.new_full((len(features), field.code_dim), torch.nan)
    if not len(known):
        return codes
    basis = None if basis is None else basis.to(known)
    for rows in (mass > 0).nonzero()[:, 0].split(_ROWS):
        part = _search(Gathered(features[rows], mass[rows], basis), field, known, basis)
        codes[rows.to(codes.device)] = part
    return codes


@torch.no_grad()
def centered_cosine(
    features: Float[Tensor, "n c"],
    field: SemanticField,
    codes: Float[Tensor, "n code"],
    basis: PrincipalBasis | None = None,
) -> float:
    """Mean cosine of decoded and given features, both less the mean feature: 1 if nothing is lost. (Without
    centering even the mean feature alone has a cosine above 0.9 with all others.)"""
    if not len(features):
        return 1.0
    basis = None if basis is None else basis.to(codes)
    (weight, bias), mean, total = _head(field, basis), features.mean(0).to(codes), 0.0
    for rows in torch.arange(len(features)).split(_ROWS):
        decoded = F.linear(field.hidden(codes[rows.to(codes.device)]), weight, bias)
        wanted = features[rows.to(features.device)].to(codes)
        total += float(F.cosine_similarity(decoded - mean, wanted - mean, dim=1).sum())
    return total / len(features)


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


class _LearningField(SemanticField):
    """A semantic field that can learn codes of features gathered onto Gaussians."""

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

    @property
    def learning_steps(self) -> int:  # type: ignore[override]
        return self.compression.steps

    def learning_seconds(self, count: int) -> float:
        draws = self.compression.grown(count).steps * self.compression.batch
        return draws * _SECONDS_PER_DRAW + count * _SECONDS_PER_GAUSSIAN

    def _step(self, gaussians: int, advance: Callable[[], None]) -> Callable[[], None]:
        """Called at every step, advances a bar that has as many steps whatever the number of Gaussians."""
        steps, growth = count(1), self.compression.growth(gaussians)
        return lambda: advance() if next(steps) % growth == 0 else None


class CompressedField(_LearningField):
    """The semantic field of a scene whose features are gathered onto its Gaussians after training: it
    decodes each Gaussian's code, before compositing. Until then there are no codes."""

    per_gaussian = True
    needs_lifting = True

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
        """Codes of three numbers; of more if those lose too much and the settings leave it open."""
        generator = torch.Generator().manual_seed(0)
        config = self.compression.grown(len(features))
        sample = seen_by_photos(features, mass, basis).sample(config.sample, generator)
        step = self._step(len(features), advance)
        state = generator.get_state()
        dims = CODE_DIMS if self.config.code_dim is None else (self.config.code_dim,)
        lost = ""
        for dim in dims:
            generator.set_state(state)
            fresh = SemanticField(replace(self.config, code_dim=dim), self.clip_dim, generator=generator)
            fresh = fresh.to(self.output_mean.device)
            codes = fit(sample, fresh, config, generator, step if dim == dims[0] else _nothing)
            found = assign(sample.features, sample.mass, fresh, codes, basis)
            cosine = centered_cosine(sample.features, fresh, found, basis)
            if cosine >= GOOD:
                break
            lost += f"; {dim} numbers: {cosine:.3f}"
        self.take(fresh)
        codes = assign(features, mass, self, found, basis)
        known = (mass > 0).to(codes.device)
        cosine = centered_cosine(seen_by_photos(features, mass, basis).features, self, codes[known], basis)
        self.learned = (
            f"features compressed to {self.code_dim} numbers per Gaussian: centered cosine {cosine:.3f}{lost}"
        )
        return codes

    def take(self, other: SemanticField) -> None:
        """Become another field, of codes of any length."""
        self.settings, self.code_dim = other.settings, other.code_dim
        self.grid, self.layers, self.output = other.grid, other.layers, other.output
        self.level_weights = other.level_weights
        self.set_output_statistics(other.output_mean, other.output_std)

    def fit_codes(self, codes: Float[Tensor, "n code"]) -> None:
        """Make room for the weights of a field of such codes, to be loaded."""
        wide = codes.shape[1] if codes.dim() == 2 else 0
        if wide != self.code_dim and 2 <= wide <= MOST_DIMENSIONS:
            self.take(SemanticField(replace(self.config, code_dim=codes.shape[1]), self.clip_dim))


class JointField(_LearningField):
    """The semantic field whose codes are trained with the scene. They may start from features gathered onto
    the Gaussians."""

    def learn_gaussians(
        self,
        features: Float[Tensor, "n clip"],
        mass: Float[Tensor, " n"],
        advance: Callable[[], None] = lambda: None,
        basis: PrincipalBasis | None = None,
    ) -> Float[Tensor, "n code"]:
        """Codes from which training goes on, and a field that decodes them."""
        generator = torch.Generator().manual_seed(0)
        config = self.compression.grown(len(features))
        step = self._step(len(features), advance)
        sample = seen_by_photos(features, mass, basis).sample(config.sample, generator)
        codes = fit(sample, self, config, generator, step)
        return assign(features, mass, self, codes, basis)


def _nothing() -> None: ...
