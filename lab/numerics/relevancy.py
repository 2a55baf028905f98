"""Hard cases of the relevancy of a feature to a prompt."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from lab.numerics.measure import EXACT, Bounds, Case, Maps, Problem
from lang3dxl_ns.query.relevancy import Queries

CHANNELS = 64
BOUNDS = {"float32": Bounds(2e-6, 1e-6, 1e-5, 5e-6), "float64": EXACT}
FAR = {"float32": Bounds(4e-6, 2e-6, 1e-5, 5e-6), "float64": EXACT}
"""Bounds for small relevancy, e^(−10 d). Its relative error is ten times the error of d, the difference of
two cosines near 1: each is rounded by 6e-8, and the rounding of the two lengths adds as much again."""
HALF = {"bf16": Bounds(3e-2, 2e-2, 1.0, 0.3), "fp16": Bounds(5e-3, 2e-3, 0.3, 5e-2)}


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Yield cases with features of any length and direction, and temperatures from 0 to 1e4."""
    features: dict[str, tuple[Callable[[], Maps], str]] = {
        "usual": (_vectors, ""),
        "antipodal to the prompt": (lambda: _vectors(features=-_vectors()["queries"]), ""),
        "equal to a prompt": (lambda: _vectors(features=_vectors()["queries"]), ""),
        "equal to a canonical phrase": (lambda: _vectors(features=_vectors()["canonical"]), ""),
        "prompt equal to a canonical phrase": (_prompt_is_canonical, "0.5 everywhere"),
        "one channel holds all": (_one_channel, ""),
        "features of 1e-10": (lambda: _vectors(1e-10), "below 1e-12 a feature counts as none"),
        "features of 1e17": (lambda: _vectors(1e17), "from 1e19 the square is infinite in float32"),
    }
    for name, (vectors, note) in features.items():
        bounds = FAR if name == "equal to a canonical phrase" else BOUNDS
        yield Case("relevancy", name, partial(_problem, vectors), bounds, note)
    note = "0.5; a cosine to nothing has no gradient"
    yield Case("relevancy", "zero vectors", partial(_problem, _with_zeros, outputs_only=True), BOUNDS, note)
    note = "NaN in its own pixel, nowhere else"
    yield Case("relevancy", "NaN", partial(_problem, _with_nan, outputs_only=True), BOUNDS, note)
    yield Case("relevancy", "temperature 0", partial(_problem, _vectors, 0.0), BOUNDS)
    sharp = {"float32": Bounds(5e-3, 1e-3, 2e-2, 5e-3), "float64": EXACT}
    note = "a cosine is off by its rounding, 1e-7, and that times 1e4"
    yield Case("relevancy", "temperature 1e4", partial(_problem, _vectors, 1e4), sharp, note)
    note = "of two phrases that fit equally well, rounding may choose the other, whose slope differs"
    yield Case("relevancy", "mixed precision", partial(_problem, _vectors), HALF, note)


def _vectors(scale: float = 1.0, features: Tensor | None = None) -> Maps:
    generator = torch.Generator().manual_seed(0)

    def normal(count: int) -> Tensor:
        return torch.randn(count, CHANNELS, generator=generator, dtype=torch.float64)

    # As in the output of one encoder, all share a direction, so cosines lie close together.
    shared = 2 * normal(1)
    queries, canonical = shared + normal(3), shared + normal(4)
    usual = scale * (shared + normal(200))
    return {"features": usual if features is None else features, "queries": queries, "canonical": canonical}


def _prompt_is_canonical() -> Maps:
    vectors = _vectors()
    return vectors | {"queries": vectors["canonical"][:1].clone(), "canonical": vectors["canonical"][:1]}


def _one_channel() -> Maps:
    vectors = _vectors()
    vectors["features"][:, 7] = 1e9
    return vectors


def _with_zeros() -> Maps:
    vectors = _vectors()
    vectors["features"][:50] = 0
    return vectors


def _with_nan() -> Maps:
    vectors = _vectors()
    vectors["features"][3, 5] = torch.nan
    return vectors


def _problem(vectors: Callable[[], Maps], temperature: float = 10.0, outputs_only: bool = False) -> Problem:
    leaves = vectors()

    def compute(given: Maps) -> Maps:
        prompts = Queries.of(given["queries"][:, None].unbind(), given["canonical"])
        cosines = prompts.cosines(given["features"])
        return {"relevancy": prompts.relevancy_of_cosines(cosines, temperature)}

    def reference(given: Maps) -> Maps:
        vectors = given["features"], given["queries"], given["canonical"]
        return {"relevancy": relevancy_reference(*vectors, temperature)}

    constants = frozenset(leaves) if outputs_only else frozenset[str]()
    # A feature parallel to a phrase has zero slope towards it.
    return Problem(leaves, compute, reference, constants=constants, gradient_scale=0.01)


def relevancy_reference(features: Tensor, queries: Tensor, canonical: Tensor, temperature: float) -> Tensor:
    """Compute the smallest softmax of a prompt against each canonical phrase, prompt by prompt."""

    def cosine(phrase: Tensor) -> Tensor:
        lengths = features.norm(dim=1) * phrase.norm()
        return torch.where(lengths == 0, 0.0, features @ phrase / torch.where(lengths == 0, 1.0, lengths))

    rows = []
    for query in queries:
        pairs = [torch.stack([cosine(query), cosine(phrase)]) for phrase in canonical]
        rows.append(torch.stack([(temperature * pair).softmax(0)[0] for pair in pairs]).amin(0))
    return torch.stack(rows)
