"""The whole catalogue. A component joins it with a file of cases and a line here."""

from __future__ import annotations

from collections.abc import Iterator

from lang3dxl_ns.evaluation.numerics import (
    appearance,
    decoder,
    downsampler,
    hash_grid,
    lookup,
    losses,
    physical_scale,
    rasteriser,
    relevancy,
)
from lang3dxl_ns.evaluation.numerics.measure import Case

GROUPS = (
    rasteriser,
    appearance,
    hash_grid,
    decoder,
    downsampler,
    losses,
    physical_scale,
    relevancy,
    lookup,
)


def all_cases(quick: bool, device: str) -> Iterator[Case]:
    """Every group's cases; `quick` takes smaller ones where the size is not the point."""
    for group in GROUPS:
        yield from group.cases(quick, device)
