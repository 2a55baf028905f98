"""True pairs of photos are those that see the same from nearby."""

import numpy as np
import pycolmap
from scenes import write_scene

from lab.benchmarks.pairs import SHARED, TURNED, matched_pairs, true_pairs


def test_true_pairs_share_points_and_look_the_same_way(tmp_path):
    """The reference goes from pair to pair."""
    model = pycolmap.Reconstruction(write_scene(tmp_path / "scene", photos=12, points=200) / "sparse" / "0")
    images = sorted(model.images.values(), key=lambda image: image.name)
    seen = [{p.point3D_id for p in image.points2D if p.has_point3D()} for image in images]
    ahead = [image.cam_from_world().rotation.matrix()[2] for image in images]
    expected = np.array(
        [
            [
                i != j
                and len(seen[i] & seen[j]) > SHARED * min(len(seen[i]), len(seen[j]))
                and np.degrees(np.arccos(np.clip(ahead[i] @ ahead[j], -1, 1))) < TURNED
                for j in range(12)
            ]
            for i in range(12)
        ]
    )
    found = true_pairs(model, [image.name for image in images])
    assert 0 < expected.sum() < 12 * 11
    np.testing.assert_array_equal(found, expected)


def test_pairs_that_were_tried_and_verified_are_read_from_the_database(tmp_path):
    """Names are numbers, whatever the order of the images; under 15 matches verify nothing."""
    with pycolmap.Database.open(tmp_path / "database.db") as db:
        camera = db.write_camera(pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 50.0, 60, 40))
        ids = {
            number: db.write_image(pycolmap.Image(f"{number:06d}.jpg", np.zeros((0, 2)), camera))
            for number in (2, 0, 1)
        }
        for one, other, count in ((0, 1, 40), (1, 2, 3)):
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.zeros((count, 2), np.uint32)
            db.write_two_view_geometry(ids[one], ids[other], geometry)
    tried, verified = matched_pairs(tmp_path / "database.db")
    assert np.argwhere(np.triu(tried)).tolist() == [[0, 1], [1, 2]]
    assert np.argwhere(np.triu(verified)).tolist() == [[0, 1]]
    assert (tried == tried.T).all() and (verified == verified.T).all()
