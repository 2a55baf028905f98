"""Symmetry: pairs between like-looking sides are left out, honest ones stay."""

import numpy as np  # before pycolmap
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from lang3dxl_ns.scene.placements import MatchedPair
from lang3dxl_ns.scene.symmetry import contradicting_pairs, contradictions, copy_without


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


def false_pairs(front, back, matches, rng):
    return [MatchedPair(i, j, matches, turned(20 * (j - i) - 180, rng)) for i in front for j in back]


def test_false_pairs_between_opposite_sides_are_left_out_alone(walk):
    pairs, rng = walk
    false = false_pairs(range(2), range(9, 11), 25, rng)
    order = rng.permutation(len(pairs) + len(false))
    found = contradicting_pairs([(pairs + false)[i] for i in order])
    assert found == {(pair.first, pair.second) for pair in false}


def test_sides_stay_apart_rather_than_fold_into_one(walk):
    """More false pairs than true ones around the corners agree: the front looks like the back."""
    pairs, rng = walk
    false = false_pairs(range(4), range(9, 13), 45, rng)
    found = contradicting_pairs(pairs + false)
    assert found >= {(pair.first, pair.second) for pair in false}
    assert not found & {(pair.first, pair.second) for pair in pairs if pair.matches == 200}


def test_numbers_and_direction_of_a_pair_do_not_matter(walk):
    pairs, rng = walk
    false = [MatchedPair(i, i + 9, 20, turned(0, rng)) for i in range(5)]
    swapped = [MatchedPair(40 - p.second, 40 - p.first, p.matches, p.turn.T) for p in pairs + false]
    found = {(40 - j, 40 - i) for i, j in contradicting_pairs(swapped)}
    assert found == contradicting_pairs(pairs + false)
    assert found == {(p.first, p.second) for p in false}


def test_few_contradicting_matches_make_no_symmetry(walk):
    """Matches of chance contradict in honest collections too, and mapping them twice would tell nothing."""
    pairs, rng = walk
    for matches, symmetric in ((15, False), (45, True)):
        assert bool(contradictions(pairs + false_pairs(range(4), range(9, 13), matches, rng))) == symmetric


def test_only_the_copy_lacks_the_pairs(tmp_path):
    database, copy = tmp_path / "database.db", tmp_path / "copy.db"
    with pycolmap.Database.open(database) as db:
        for pair in ((1, 2), (1, 3)):
            db.write_two_view_geometry(*pair, pycolmap.TwoViewGeometry(inlier_matches=np.zeros((20, 2), int)))
    copy_without({(1, 3)}, database, copy)
    for path, kept in ((database, 2), (copy, 1)):
        with pycolmap.Database.open(path) as db:
            assert len(db.read_two_view_geometry_num_inliers()[0]) == kept
            assert db.exists_two_view_geometry(1, 2)
