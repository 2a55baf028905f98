"""Symmetry: pairs between like-looking sides are left out, honest ones stay."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lang3dxl_ns.scene.placements import MatchedPair
from lang3dxl_ns.scene.symmetry import contradicting_pairs


def turned(degrees, rng):
    """The rotation of a camera that was turned around the building, measured roughly."""
    error = Rotation.from_rotvec(rng.normal(0, np.radians(4), 3))
    return (error * Rotation.from_euler("y", degrees, degrees=True)).as_matrix()


@pytest.fixture
def walk():
    """Eighteen photos around a building, each matched with two neighbors on both sides; the pairs at the four
    corners are weak."""
    rng = np.random.default_rng(0)
    at = {i: 20 * i for i in range(18)}
    pairs = []
    for i in range(18):
        for apart in (1, 2):
            j = (i + apart) % 18
            corner = at[i] // 90 != at[j] // 90
            pairs.append(MatchedPair(i, j, 60 if corner else 200, turned(20 * apart, rng)))
    return pairs, rng


def test_honest_pairs_stay_in_any_order(walk):
    pairs, rng = walk
    assert contradicting_pairs(pairs) == set()
    assert contradicting_pairs([pairs[i] for i in rng.permutation(len(pairs))]) == set()
    assert contradicting_pairs([]) == set()


def test_many_weak_pairs_between_opposite_sides_are_left_out(walk):
    """They outnumber the pairs around the corners, and agree: the front looks like the back."""
    pairs, rng = walk
    front, back = range(4), range(9, 13)
    false = [MatchedPair(i, j, 45, turned(20 * (j - i) - 180, rng)) for i in front for j in back]
    order = rng.permutation(len(pairs) + len(false))
    found = contradicting_pairs([(pairs + false)[i] for i in order])
    assert found == {(pair.first, pair.second) for pair in false}


def test_numbers_and_direction_of_a_pair_do_not_matter(walk):
    pairs, rng = walk
    false = [MatchedPair(i, i + 9, 50, turned(0, rng)) for i in range(9)]
    swapped = [MatchedPair(40 - p.second, 40 - p.first, p.matches, p.turn.T) for p in pairs + false]
    found = {(40 - j, 40 - i) for i, j in contradicting_pairs(swapped)}
    assert found == contradicting_pairs(pairs + false)
    assert found == {(p.first, p.second) for p in false}
