"""Doubtful placements: none on an honest model; a photo on the wrong side is named."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lang3dxl_ns.scene.placements import MatchedPair, doubtful_placements


def turned(degrees: float) -> np.ndarray:
    return Rotation.from_euler("y", degrees, degrees=True).as_matrix()


@pytest.fixture
def ring():
    """Twelve photos around a building, each matched with its two neighbors on both sides."""
    rotations = {i: turned(30 * i) for i in range(12)}
    pairs = [
        MatchedPair(i, j, 100, rotations[j] @ rotations[i].T @ turned(2))
        for i in range(12)
        for j in ((i + 1) % 12, (i + 2) % 12)
    ]
    return rotations, pairs


def test_honest_models_have_no_doubt(ring):
    assert doubtful_placements(*ring) == {}


def test_a_photo_on_the_wrong_side_is_named_alone(ring):
    """It looks like photo 9 and its neighbors, and matches them, but more so its true neighbors."""
    rotations, pairs = ring
    like = [MatchedPair(3, j, 60, rotations[j] @ rotations[9].T) for j in (8, 9, 10)]
    rotations[3] = rotations[9]
    (found,) = doubtful_placements(rotations, pairs + like).items()
    assert found == (3, "most of its matches are with photos that stand elsewhere")


def test_false_matches_between_like_sides_do_not_accuse_right_photos(ring):
    rotations, pairs = ring
    false = [MatchedPair(i, i + 6, 90, np.eye(3)) for i in range(6)]
    assert doubtful_placements(rotations, pairs + false) == {}


def test_a_photo_that_hangs_on_one_other_is_named(ring):
    rotations, pairs = ring
    rotations[12] = turned(15)
    last = MatchedPair(0, 12, 40, rotations[12] @ rotations[0].T)
    assert doubtful_placements(rotations, [*pairs, last]) == {12: "only one other photo supports it"}
