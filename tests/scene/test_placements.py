"""Doubtful placements: none on an honest model; a photo on the wrong side is named."""

import numpy as np  # before pycolmap
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from lang3dxl_ns.scene.placements import MatchedPair, doubtful_placements, matched_pairs


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
    assert found == (3, "most of its matches are with photos placed elsewhere")


def test_false_matches_between_like_sides_do_not_accuse_right_photos(ring):
    rotations, pairs = ring
    false = [MatchedPair(i, i + 6, 90, np.eye(3)) for i in range(6)]
    assert doubtful_placements(rotations, pairs + false) == {}


def test_a_photo_that_hangs_on_one_other_is_named(ring):
    rotations, pairs = ring
    rotations[12] = turned(15)
    last = MatchedPair(0, 12, 40, rotations[12] @ rotations[0].T)
    assert doubtful_placements(rotations, [*pairs, last]) == {12: "only one other photo supports it"}


def test_a_pair_turns_as_its_lenses_see_its_matches(tmp_path):
    """Whatever fundamental matrix the database has: it leaves the rotation open where lenses are unknown."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1, 4], [2, 1, 6], (80, 3))
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 700.0, 800, 600)
    turn = turned(25)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.array([-2.0, 0.1, 0.3]))
    seen = [camera.img_from_cam(points), camera.img_from_cam(points @ turn.T + pose.translation)]
    ends = np.repeat(np.arange(80, dtype=np.uint32)[:, None], 2, axis=1)
    with pycolmap.Database.open(tmp_path / "database.db") as db:
        for number, pixels in enumerate(seen, 1):
            pixels += rng.normal(0, 0.3, pixels.shape)
            db.write_camera(
                pycolmap.Camera.create_from_model_name(number, "SIMPLE_PINHOLE", 960.0, 800, 600), True
            )
            db.write_image(pycolmap.Image(f"{number}.jpg", np.zeros((0, 2)), number, number), True)
            db.write_keypoints(number, pixels.astype(np.float32))
        wrong = pycolmap.TwoViewGeometry(config=3, F=rng.normal(size=(3, 3)), inlier_matches=ends)
        db.write_two_view_geometry(1, 2, wrong)
        (pair,) = matched_pairs(db, {1: camera, 2: camera})
    assert pair.matches > 70
    assert np.degrees(Rotation.from_matrix(pair.turn @ turn.T).magnitude()) < 2
