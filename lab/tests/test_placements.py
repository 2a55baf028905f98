"""Photos that stand wrong in a model are found, whatever the model's frame, and by how many pixels."""

import numpy as np
import pycolmap
import pytest
from scenes import write_scene

from lab.benchmarks.placements import pixels_off, wrong_photos


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


def test_a_turned_photo_alone_is_off_by_as_many_pixels_as_it_was_turned(tmp_path):
    model = write_scene(tmp_path / "scene", photos=12) / "sparse" / "0"
    found = pycolmap.Reconstruction(model)
    image = next(i for i in found.images.values() if i.name == "photo_004.jpg")
    turn = pycolmap.Rotation3d(np.array([0, 0.005, 0, 1]) / np.linalg.norm([0, 0.005, 0, 1]))  # .01 about y
    pose = pycolmap.Rigid3d(turn, np.zeros(3)) * image.cam_from_world()
    found.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
    found.transform(pycolmap.Sim3d(0.3, turn, np.array([1.0, 2.0, 3.0])))
    (tmp_path / "found").mkdir()
    found.write(tmp_path / "found")
    off = pixels_off(model, tmp_path / "found")
    turned = off.pop("photo_004.jpg")
    assert turned == pytest.approx(0.01 * image.camera.mean_focal_length(), rel=0.1)
    assert len(off) == 11 and max(off.values()) < turned / 3
