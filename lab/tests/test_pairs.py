"""True pairs of photos are those that see the same from nearby."""

import numpy as np
import pycolmap
from scenes import write_scene

from lab.benchmarks.pairs import SHARED, TURNED, true_pairs


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
