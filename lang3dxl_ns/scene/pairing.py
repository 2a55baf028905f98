"""Photo pairs to match: all of a few photos; of more, those whose largest features seem to match, and then
those that match the same others."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.console import progress

EXHAUSTIVE = 100
"""Largest number of photos for which every pair is matched, which makes 4,950 pairs."""
ALIKE, SHARING, ROUNDS = 20, 20, 2
"""Most photos with which each is paired in larger collections: for its looks, and then, in so many rounds,
for the partners that both have."""
_PER_PHOTO = 300
"""Features per photo that are compared: the largest, which others see from afar too."""
_CLEARLY = 0.7
"""How much nearer the nearest descriptor must be than the second, as a share of its distance (Lowe 2004)."""
_AT_ONCE = 64  # photos compared with one

Descriptors = Callable[[str], UInt8[Array, "n 128"]]
"""Function from a photo's name to the SIFT descriptors of its features, the largest first."""


def pairs_to_match(
    names: Sequence[str], descriptors: Descriptors, new: Collection[str], walks: Iterable[Sequence[str]]
) -> list[tuple[str, str]]:
    """List the pairs to begin with: all of up to `EXHAUSTIVE` photos; of more, `similar_pairs` of the new
    ones, and neighbors in the order of names, as of a video, and of each walk."""
    if len(names) <= EXHAUSTIVE:
        return list(combinations(names, 2))
    found = set(similar_pairs(names, descriptors, new))
    for walk in (names, *walks):
        for apart in (1, 2, 4, 8):
            found.update((min(pair), max(pair)) for pair in zip(walk[:-apart], walk[apart:], strict=True))
    return sorted(found)


def similar_pairs(
    names: Sequence[str], descriptors: Descriptors, new: Collection[str]
) -> list[tuple[str, str]]:
    """Pair each new photo with the `ALIKE` photos in which most of its largest features have a match
    (preemptive matching, Wu 2013)."""
    names = sorted(names, key=lambda name: name not in new)  # the new ones first
    rows = torch.stack([_rows(descriptors(name)) for name in names])
    counts = np.zeros((len(new), len(names)), dtype=int)
    with progress("photos compared", len(new)) as advance:
        for i in range(len(new)):
            counts[i, i + 1 :] = _possible_matches(rows[i], rows[i + 1 :])
            counts[i + 1 :, i] = counts[i, i + 1 : len(new)]
            advance(1)
    return best_pairs(names, counts, ALIKE)


def pairs_that_share(
    names: Sequence[str], tried: Collection[tuple[str, str]], matched: Collection[tuple[str, str]]
) -> list[tuple[str, str]]:
    """Pair each photo with the `SHARING` photos that match most of those that it matches, without pairs that
    were tried. `matched` are those of the tried pairs that match."""
    number = {name: i for i, name in enumerate(names)}
    done, matches = np.eye(len(names), dtype=bool), np.zeros((len(names), len(names)), np.float32)
    for table, pairs in ((done, tried), (matches, matched)):
        for one, other in pairs:
            table[number[one], number[other]] = table[number[other], number[one]] = 1
    return best_pairs(names, (matches @ matches * ~done).astype(int), SHARING)


def best_pairs(names: Sequence[str], scores: Int[Array, "m n"], count: int) -> list[tuple[str, str]]:
    """Pair each of the first m photos with the `count` of the highest positive score."""
    best = np.argsort(-scores, axis=1, kind="stable")[:, :count]
    found = ((i, j) for i, others in enumerate(best.tolist()) for j in others if scores[i, j] > 0)
    return sorted({(min(names[i], names[j]), max(names[i], names[j])) for i, j in found})


def _rows(descriptors: UInt8[Array, "n 128"]) -> Float[Tensor, "m 128"]:
    """Convert the descriptors of the largest features to RootSIFT, with zeros for those that are missing."""
    rows = torch.zeros(_PER_PHOTO, 128)
    found = torch.from_numpy(descriptors[:_PER_PHOTO].astype(np.float32))
    rows[: len(found)] = torch.sqrt(found / found.sum(1, keepdim=True).clamp_min(1e-9))
    return rows


def _possible_matches(photo: Float[Tensor, "m 128"], others: Float[Tensor, "k m 128"]) -> Int[Array, " k"]:
    """Count the features of each other photo that are clearly nearest to a feature of this one."""
    counts = []
    for some in others.split(_AT_ONCE):
        cosines = (photo @ some.flatten(0, 1).T).unflatten(1, some.shape[:2])
        nearest, where = cosines.max(2)
        second = cosines.scatter_(2, where[..., None], -1.0).amax(2)
        clear = 1 - nearest < _CLEARLY**2 * (1 - second)
        found = torch.zeros(len(some), len(photo) + 1)
        # The last column takes the unclear ones.
        found.scatter_(1, torch.where(clear, where, len(photo)).T, 1.0)
        counts.append(found[:, :-1].sum(1))
    return torch.cat(counts).int().numpy() if counts else np.zeros(0, dtype=int)
