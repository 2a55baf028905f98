"""Hard cases of compressing features to three numbers per Gaussian."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from lab.numerics.measure import Bounds, Case, Maps, Problem
from lang3dxl_ns.components.compression import assign, draw_sample, fit, seen_by_photos
from lang3dxl_ns.components.feature_decoder import Gathered
from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.components.semantic_field import SemanticField

COUNT, CHANNELS, KINDS = 2_000, 32, 12
RARE = 0.005
"""Share of the Gaussians that are of the rarest kind."""
FIT = {"float32": Bounds(0.5, 0.05)}
"""A fit, not a rounding: the largest error may be half a feature, the RMS 5 %."""


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Features of a few kinds of things, one of them rare; masses and sizes of all magnitudes."""
    note = f"decoded, against the features; a kind on {RARE:.1%} of the Gaussians counts as much as all"
    problems: dict[str, Callable[[], Problem]] = {
        "one material": partial(_problem, kinds=1, steps=100 if quick else 1_000),
        "12 kinds": _problem,
        "features of 1e4": partial(_problem, size=1e4),
        "features of 1e-6": partial(_problem, size=1e-6),
        "half of the Gaussians in no photo": partial(_problem, unseen=0.5),
    }
    for name, problem in list(problems.items())[: 1 if quick else None]:
        yield Case("compression", name, problem, FIT, note)
    if not quick:
        note = "Gaussians of a millionth of a pixel are hardly ever drawn, and keep their first guess"
        faint = {"float32": Bounds(1.0, 0.4)}
        yield Case("compression", "masses from 1e-6 to 1e6", partial(_problem, masses=6.0), faint, note)


def compress(
    features: Tensor,
    mass: Tensor,
    field: SemanticField,
    config: CompressionConfig,
    generator: torch.Generator,
    basis: PrincipalBasis | None = None,
) -> Tensor:
    """Codes of a field that is given, as `CompressedField` learns them for its own."""
    config = config.grown(len(features))
    gathered = Gathered(features, mass, basis)
    sample = draw_sample(seen_by_photos(gathered), config.sample, generator)
    return assign(gathered, field, fit(sample, field, config, generator))


def _problem(
    kinds: int = KINDS, size: float = 1.0, masses: float = 0.0, unseen: float = 0.0, steps: int = 1_000
) -> Problem:
    generator = torch.Generator().manual_seed(0)
    kind = torch.arange(COUNT) % max(kinds - 1, 1)
    rare = torch.arange(COUNT) < RARE * COUNT
    if kinds > 1:
        kind[rare] = kinds - 1
    features = size * torch.randn(kinds, CHANNELS, generator=generator, dtype=torch.float64)[kind]
    mass = 10 ** (masses * (2 * torch.rand(COUNT, generator=generator, dtype=torch.float64) - 1))
    seen = torch.rand(COUNT, generator=generator) >= unseen

    def figures(decoded: Tensor) -> Maps:
        return {"all": decoded[seen], "the rarest": decoded[rare & seen]}

    def compute(given: Maps) -> Maps:
        field = SemanticField(
            SemanticFieldConfig("short"), CHANNELS, generator=torch.Generator().manual_seed(0)
        ).to(given["features"])
        weight = torch.where(seen.to(given["mass"].device), given["mass"], 0.0)
        config = CompressionConfig(steps, batch=512)
        batches = torch.Generator().manual_seed(0)
        codes = compress(given["features"].detach(), weight.detach(), field, config, batches)
        assert bool(codes[~seen].isnan().all()), "Gaussians in no photo are unknown"
        return figures(field.decode_clip(codes.nan_to_num()).detach())

    def reference(given: Maps) -> Maps:
        return figures(given["features"])

    leaves = {"features": features, "mass": mass}
    return Problem(leaves, compute, reference, constants=frozenset(leaves))
