"""Catalog of all numerics cases; to add a component, add a file of cases and a line here."""

from __future__ import annotations

from collections.abc import Iterator

from lang3dxl_ns.numerics import appearance, decoder, downsampler, hash_grid, losses, rasterizer, relevancy
from lang3dxl_ns.numerics.measure import Case

GROUPS = (rasterizer, appearance, hash_grid, decoder, downsampler, losses, relevancy)


def all_cases(quick: bool, device: str) -> Iterator[Case]:
    """All cases; `quick` shrinks those where size is not the point."""
    for group in GROUPS:
        yield from group.cases(quick, device)
