"""Hard cases of the principal components that features are gathered in."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from lab.numerics.measure import Bounds, Case, Maps, Problem
from lang3dxl_ns.components.principal_basis import PrincipalBasis

ROWS, CHANNELS, RANK = 900, 48, 8
BOUNDS = {"float32": Bounds(1e-6, 5e-7)}
"""Moments in float32 would miss this."""


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Features of low rank with means and spreads of all magnitudes."""
    note = "features projected and brought back, against the nearest ones of this rank by SVD"
    problems: dict[str, Callable[[], Problem]] = {
        "usual features": _problem,
        "a mean of 100 deviations": partial(_problem, mean=100.0),
        "features of 1e-6": partial(_problem, size=1e-6),
        "features of 1e6": partial(_problem, size=1e6),
        "deviations from 1 to 1e-3": partial(_problem, decay=3.0),
        "fewer rows than components": partial(_problem, rows=RANK - 2),
        "all rows alike": partial(_problem, size=0.0, mean=1.0),
    }
    for name, problem in problems.items():
        yield Case("principal basis", name, problem, BOUNDS, note)


def _problem(rows: int = ROWS, mean: float = 1.0, size: float = 1.0, decay: float = 0.0) -> Problem:
    generator = torch.Generator().manual_seed(0)
    random = partial(torch.randn, generator=generator, dtype=torch.float64)
    deviations = 10 ** (-decay * torch.arange(CHANNELS) / CHANNELS)
    features = (size or 1.0) * mean + size * random(rows, CHANNELS) * deviations

    def compute(given: Maps) -> Maps:
        known = given["features"].detach()
        basis = PrincipalBasis.of(known.split(100), RANK).to(known)
        return {"features": basis.features(basis.coordinates(known))}

    def reference(given: Maps) -> Maps:
        return {"features": _nearest(given["features"])}

    return Problem({"features": features}, compute, reference, constants=frozenset({"features"}))


def _nearest(features: Tensor) -> Tensor:
    """The features of the least squared error that lie in a plane of `RANK` dimensions."""
    mean = features.mean(0)
    left, values, right = torch.linalg.svd(features - mean, full_matrices=False)
    return mean + (left[:, :RANK] * values[:RANK]) @ right[:RANK]
