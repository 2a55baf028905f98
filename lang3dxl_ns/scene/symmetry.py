"""Symmetry: pairs of photos that match although they show different sides of a building, which look alike.

A single pair doesn't tell: two towers match as two views of one tower do. But its rotation contradicts those of
other pairs, around the building and through photos that see both sides. The photos are joined into groups,
along the best supported rotations first; a pair that contradicts its group is left out of the mapping.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from lang3dxl_ns.scene.placements import MatchedPair, matched_pairs

if TYPE_CHECKING:
    import pycolmap

APART = 30.0
"""Degrees between a pair's rotation and its group's from which the pair contradicts the group. Focal lengths
are guesses before mapping, which turns rotations by up to about half of this."""
_VOTES = 30
"""Strongest pairs between two groups that vote on the rotation between them."""
_VOICES = 3
"""Strongest agreeing votes that decide which groups are joined first: many weak pairs between like sides must
not outweigh few strong ones around a corner."""


@dataclass
class _Groups:
    """Photos in groups; a photo's rotation is that of its group's frame → camera."""

    group: dict[int, int]
    rotation: dict[int, Float[Array, "3 3"]]

    def turn(self, pair: MatchedPair) -> Float[Array, "3 3"]:
        """Return the rotation from the second photo's group to the first's that a pair measures."""
        return self.rotation[pair.first].T @ pair.turn.T @ self.rotation[pair.second]

    def join(self, kept: int, joined: int, turn: Float[Array, "3 3"]) -> None:
        """Join a group to another, by the rotation from its frame to the other's."""
        for photo in [photo for photo, group in self.group.items() if group == joined]:
            self.group[photo] = kept
            self.rotation[photo] = self.rotation[photo] @ turn.T


def contradicting_pairs(
    pairs: Sequence[MatchedPair], strengths: Mapping[tuple[int, int], float]
) -> set[tuple[int, int]]:
    """Find the pairs whose rotations contradict those of stronger ones.

    Args:
        pairs: verified pairs of photos. strengths: how much each counts, by the photos' numbers in the pair's
            order; above 0.
    """
    photos = {photo for pair in pairs for photo in (pair.first, pair.second)}
    groups = _Groups({photo: photo for photo in photos}, {photo: np.eye(3) for photo in photos})
    between: dict[tuple[int, int], list[MatchedPair]] = defaultdict(list)
    for pair in sorted(pairs, key=lambda pair: -strengths[pair.first, pair.second]):
        between[_key(pair.first, pair.second)].append(pair)
    votes = {key: _vote(groups, key, found, strengths) for key, found in between.items()}
    while votes:
        (kept, joined), (turn, _) = max(votes.items(), key=lambda vote: vote[1][1])
        groups.join(kept, joined, turn)
        touched = {kept, joined}
        changed = [key for key in between if touched & set(key)]
        moved: dict[tuple[int, int], list[MatchedPair]] = defaultdict(list)
        for key in changed:
            votes.pop(key)
            ends = [kept if end == joined else end for end in key]
            if ends[0] != ends[1]:
                moved[_key(*ends)] += between[key]
            del between[key]
        for key, found in moved.items():
            found.sort(key=lambda pair: -strengths[pair.first, pair.second])
            between[key] = found
            votes[key] = _vote(groups, key, found, strengths)
    return {
        (pair.first, pair.second) for pair in pairs if _degrees(groups.turn(pair)[None], np.eye(3))[0] > APART
    }


def _key(one: int, other: int) -> tuple[int, int]:
    return min(one, other), max(one, other)


def _vote(
    groups: _Groups,
    key: tuple[int, int],
    pairs: list[MatchedPair],
    strengths: Mapping[tuple[int, int], float],
) -> tuple[Float[Array, "3 3"], float]:
    """Return the rotation from the second group to the first that the pairs between them agree on, and the
    weight of the agreement."""
    voting = pairs[:_VOTES]
    turns = np.stack(
        [groups.turn(p) if groups.group[p.first] == key[0] else groups.turn(p).T for p in voting]
    )
    weights = np.array([strengths[p.first, p.second] for p in voting])
    best, heaviest = turns[0], -1.0
    for turn in turns:
        agreeing = weights[_degrees(turns, turn) < APART / 2][:_VOICES]
        if agreeing.sum() > heaviest:
            best, heaviest = turn, float(agreeing.sum())
    near = _degrees(turns, best) < APART / 2
    mean = Rotation.from_matrix(turns[near]).mean(weights[near]).as_matrix()
    return mean, heaviest


def _degrees(turns: Float[Array, "n 3 3"], other: Float[Array, "3 3"]) -> Float[Array, " n"]:
    cosines = (np.einsum("nij,ij->n", turns, other) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))
