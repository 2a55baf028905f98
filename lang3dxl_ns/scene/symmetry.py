"""Symmetry: pairs of photos that match although they show different sides of a building, which look alike.

A single pair doesn't tell: two towers match as two views of one tower do. But its rotation contradicts those
of other pairs, around the building and through photos that see both sides. The photos are joined into groups,
along the best supported rotations first; a pair that contradicts its group is left out of the mapping.
Groups between which too many pairs disagree stay apart.
"""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

from lang3dxl_ns.scene.colmap import load_pycolmap
from lang3dxl_ns.scene.placements import MatchedPair

APART = 40.0
"""Degrees between a pair's rotation and its group's from which the pair contradicts the group. Focal lengths
are guesses before mapping, which turns rotations by up to about half of this."""
AGREEMENT = 0.55
"""Share of the matches between two groups that has to agree on a rotation, or else the groups stay apart."""
SYMMETRIC = 0.05
"""Share of contradicting matches above which a building has sides that look alike: honest collections have a
hundredth, generated landmarks a tenth and more."""
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


def contradictions(pairs: Sequence[MatchedPair]) -> set[tuple[int, int]]:
    """Find the pairs whose rotations contradict others; none if their matches are few, as on buildings
    without symmetry. The cameras of a first model measure rotations better than a database's guesses."""
    found = contradicting_pairs(pairs)
    matches = sum(pair.matches for pair in pairs if (pair.first, pair.second) in found)
    return found if matches > SYMMETRIC * sum(pair.matches for pair in pairs) else set()


def copy_without(pairs: Collection[tuple[int, int]], database: Path, copy: Path) -> None:
    """Write a copy of COLMAP's database that lacks the geometry of some pairs."""
    with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)
    with load_pycolmap().Database.open(copy) as db:
        for first, second in pairs:
            db.delete_two_view_geometry(first, second)


def contradicting_pairs(pairs: Sequence[MatchedPair]) -> set[tuple[int, int]]:
    """Find the pairs, by their photos' numbers, whose rotations contradict those of stronger ones."""
    photos = {photo for pair in pairs for photo in (pair.first, pair.second)}
    groups = _Groups({photo: photo for photo in photos}, {photo: np.eye(3) for photo in photos})
    between: dict[tuple[int, int], list[MatchedPair]] = defaultdict(list)
    for pair in pairs:
        between[_key(pair.first, pair.second)].append(pair)
    votes = {key: _vote(groups, key, found) for key, found in between.items()}
    while votes:
        (kept, joined), (turn, weight) = max(votes.items(), key=lambda vote: vote[1][1])
        if weight == 0:
            break
        groups.join(kept, joined, turn)
        moved: dict[tuple[int, int], list[MatchedPair]] = defaultdict(list)
        for key in [key for key in between if kept in key or joined in key]:
            del votes[key]
            first, second = (kept if end == joined else end for end in key)
            found = between.pop(key)
            if first != second:
                moved[_key(first, second)] += found
        votes |= {key: _vote(groups, key, found) for key, found in moved.items()}
        between |= moved
    together = [groups.group[pair.first] == groups.group[pair.second] for pair in pairs]
    near = [_degrees(groups.turn(pair)[None], np.eye(3))[0] < APART for pair in pairs]
    sound = np.logical_and(together, near)
    return {(pair.first, pair.second) for pair, kept in zip(pairs, sound, strict=True) if not kept}


def _key(one: int, other: int) -> tuple[int, int]:
    return min(one, other), max(one, other)


def _vote(
    groups: _Groups, key: tuple[int, int], pairs: list[MatchedPair]
) -> tuple[Float[Array, "3 3"], float]:
    """Return the rotation from the second group to the first that the pairs between them agree on, and the
    weight of the agreement; 0 if they disagree too much to tell."""
    voting = sorted(pairs, key=lambda pair: -pair.matches)[:_VOTES]
    turns = np.stack(
        [groups.turn(p) if groups.group[p.first] == key[0] else groups.turn(p).T for p in voting]
    )
    weights = np.array([pair.matches for pair in voting], float)
    agreeing = [_degrees(turns, turn) < APART / 2 for turn in turns]
    weight = [weights[near][:_VOICES].sum() for near in agreeing]
    near = agreeing[int(np.argmax(weight))]
    agreed = weights[near].sum() > AGREEMENT * weights.sum()
    return Rotation.from_matrix(turns[near]).mean(weights[near]).as_matrix(), float(max(weight) * agreed)


def _degrees(turns: Float[Array, "n 3 3"], other: Float[Array, "3 3"]) -> Float[Array, " n"]:
    cosines = (np.einsum("nij,ij->n", turns, other) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))
