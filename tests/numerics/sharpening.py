"""Hard cases of sharpening gathered features by groups of alike dense features."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch

from lab.numerics.measure import Bounds, Case, Maps, Problem
from lang3dxl_ns.training.sharpening import sharpen

COUNT, CHANNELS, AXES, KINDS = 4_000, 32, 8, 40
BOUNDS = {"float32": Bounds(2e-6, 5e-7), "float64": Bounds(1e-12, 1e-12)}


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Materials that dense features tell apart, in groups, masses and units of all magnitudes."""
    note = "fewer kinds of dense features than groups: each is one, whose mean is known"
    problems: dict[str, Callable[[], Problem]] = {
        "40 materials": _problem,
        "one material": partial(_problem, kinds=1),
        "features of 1e6": partial(_problem, size=1e6),
        "features of 1e-6": partial(_problem, size=1e-6),
        "a mean of 1e3 deviations": partial(_problem, mean=1e3),
        "masses from 1e-12 to 1e12": partial(_problem, masses=12.0),
        "masses of 1e-38": partial(_problem, mass=1e-38),
        "masses of 1e37": partial(_problem, mass=1e37),
        "NaN where no photo looks": partial(_problem, unseen=0.5),
        "dense features of 1e-6": partial(_problem, dense=1e-6),
        "dense features of 1e6": partial(_problem, dense=1e6),
        "dense features far from 0": partial(_problem, away=1e4),
    }
    for name, problem in problems.items():
        yield Case("sharpening", name, problem, BOUNDS, note)


def _problem(
    kinds: int = KINDS,
    size: float = 1.0,
    mean: float = 0.0,
    masses: float = 0.0,
    mass: float = 1.0,
    unseen: float = 0.0,
    dense: float = 1.0,
    away: float = 0.0,
) -> Problem:
    generator = torch.Generator().manual_seed(0)
    random = partial(torch.randn, generator=generator, dtype=torch.float64)
    kind = torch.arange(COUNT) % kinds
    seen = torch.rand(COUNT, generator=generator) >= unseen
    leaves = {
        "features": size * (mean + random(COUNT, CHANNELS)),
        "dense": dense * (away + random(kinds, AXES)[kind]),
        "mass": mass * 10 ** (masses * (2 * torch.rand(COUNT, generator=generator, dtype=torch.float64) - 1)),
    }
    leaves["mass"][~seen] = 0
    leaves["features"][~seen] = leaves["dense"][~seen] = torch.nan

    def compute(given: Maps) -> Maps:
        sharp = sharpen(*(given[name].detach() for name in leaves))
        return {"seen": sharp[seen], "in no photo": sharp[~seen].nan_to_num()}

    def reference(given: Maps) -> Maps:
        features, weight = given["features"][seen], given["mass"][seen]
        means = torch.stack(
            [
                (weight[k][:, None] * features[k]).sum(0) / weight[k].sum()
                for k in (kind[seen] == one for one in range(kinds))
            ]
        )
        return {
            "seen": (features + means[kind[seen]]) / 2,
            "in no photo": torch.zeros(int((~seen).sum()), CHANNELS),
        }

    return Problem(leaves, compute, reference, constants=frozenset(leaves))
