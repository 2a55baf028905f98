"""Catalog of all numerics cases; to add a component, add a file of cases and its module here."""

from __future__ import annotations

from collections.abc import Iterator

from lab.numerics import appearance, decoder, downsampler, hash_grid, losses, rasterizer, relevancy
from lab.numerics.measure import Case

GROUPS = (rasterizer, relevancy, appearance, hash_grid, decoder, downsampler, losses)
"""Modules of cases, for rendering, queries and training."""


def all_cases(quick: bool, device: str) -> Iterator[Case]:
    """Yield all cases; `quick` shrinks those that do not test size."""
    for group in GROUPS:
        yield from group.cases(quick, device)
