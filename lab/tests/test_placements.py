"""Photos that stand wrong in a model are found, whatever the model's frame."""

import numpy as np
import pycolmap
import pytest
from scenes import write_scene

from lab.benchmarks.placements import wrong_photos


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_a_moved_photo_is_wrong_in_any_frame(tmp_path, scale):
    model = write_scene(tmp_path / "scene", photos=12) / "sparse" / "0"
    found = pycolmap.Reconstruction(model)
    image = next(i for i in found.images.values() if i.name == "photo_004.jpg")
    pose = image.cam_from_world()
    moved = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([1.5, 0, 0]))
    found.frame(image.frame_id).set_cam_from_world(image.camera_id, moved)
    turn = pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3, 0.9]) / np.linalg.norm([0.1, 0.2, 0.3, 0.9]))
    found.transform(pycolmap.Sim3d(scale, turn, np.array([1.0, 2.0, 3.0])))
    (tmp_path / "found").mkdir()
    found.write(tmp_path / "found")
    off, wrong = wrong_photos(model, tmp_path / "found", 0.05)
    assert len(off) == 12 and wrong == {"photo_004.jpg"}
    assert {name for name, distance in off.items() if distance > 1e-3} == wrong
