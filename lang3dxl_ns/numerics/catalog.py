"""Catalog of all numerics cases; to add a component, add a file of cases and its name here."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

from lang3dxl_ns.common.laboratory import has_laboratory
from lang3dxl_ns.numerics import rasterizer, relevancy
from lang3dxl_ns.numerics.measure import Case

OF_TRAINING = ("appearance", "hash_grid", "decoder", "downsampler", "losses")
"""Components that training alone uses; their cases are in `lab/numerics`, which comes with a checkout."""


def groups() -> list[ModuleType]:
    """Modules of cases: rendering and answers, and, in a checkout, what training uses."""
    of_training = OF_TRAINING if has_laboratory() else ()
    return [rasterizer, relevancy, *(import_module(f"lab.numerics.{name}") for name in of_training)]


def optimizations(quick: bool) -> list[Any]:
    """Finished long runs of the semantic field (`lab.numerics.optimization.Run`), in a checkout."""
    return import_module("lab.numerics.optimization").runs(quick) if has_laboratory() else []


def all_cases(quick: bool, device: str) -> Iterator[Case]:
    """All cases; `quick` shrinks those where size is not the point."""
    for group in groups():
        yield from group.cases(quick, device)
