"""Laws of orientation: a photo turned as a whole shows the same, wherever its pixels were stored."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.capture import open_capture
from lang3dxl_ns.scene.colmap import TrackedPhoto
from lang3dxl_ns.scene.photo import Photo, stored_size, turned_lens, upright

LENS = Lens(60, 40, 70.0, 75.0, 28.0, 21.0, (-0.2, 0.05, 0.01, -0.015))
STORED = {1: 6, 2: 3, 3: 8}
"""EXIF's orientation by quarter turns."""


def tracked(name="a.png"):
    """A photo of eight points, whose pixels are where OpenCV projects them."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.4) for y in (-0.3, 0.2) for z in (2.0, 3.0)])
    pose = np.hstack([cv2.Rodrigues(np.array([0.1, 0.2, 0.3]))[0], [[0.1], [0.0], [0.2]]])
    return TrackedPhoto(name, LENS, pose, corners, projected(LENS, pose, corners))


def projected(lens, pose, points):
    vector = cv2.Rodrigues(np.ascontiguousarray(pose[:, :3]))[0]
    pixels = cv2.projectPoints(points, vector, pose[:, 3], lens.matrix.numpy(), np.array(lens.distortion))
    return pixels[0].reshape(-1, 2)


def store(path, pixels, quarters):
    """Saves upright pixels lying, as a phone does."""
    exif = Image.Exif()
    exif[0x0112] = STORED[quarters]
    Image.fromarray(np.ascontiguousarray(np.rot90(pixels, quarters))).save(path, exif=exif)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_points_project_into_the_turned_photo_where_they_are_tracked(quarters):
    photo = tracked()
    turned = upright(photo, (60, 40), quarters)
    assert turned.quarter_turns == quarters
    np.testing.assert_allclose(
        projected(turned.lens, turned.camera_from_world, turned.points), turned.pixels, atol=1e-9
    )
    np.testing.assert_allclose(turned.center, photo.center, atol=1e-12)
    again = upright(replace(turned, quarter_turns=0), (turned.width, turned.height), 4 - quarters)
    assert again.lens == photo.lens
    np.testing.assert_allclose(again.camera_from_world, photo.camera_from_world, atol=1e-12)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_photo_stored_lying_is_read_as_the_same_photo_stored_upright(tmp_path, quarters):
    seen = upright(tracked(), (60, 40), quarters)  # what a camera held so sees upright
    noise = np.random.default_rng(0).integers(0, 256, (seen.height // 4, seen.width // 4, 3), dtype=np.uint8)
    pixels = noise.repeat(4, 0).repeat(4, 1)
    Image.fromarray(pixels).save(tmp_path / "upright.png")
    store(tmp_path / "lying.png", pixels, quarters)
    assert np.array_equal(ImageOps.exif_transpose(Image.open(tmp_path / "lying.png")), pixels)
    straight = Photo("a", tmp_path / "upright.png", None, turned_lens(LENS, quarters))
    lying = Photo.from_model(
        upright(tracked(), *stored_size(tmp_path / "lying.png", "lying")), tmp_path / "lying.png"
    )
    assert lying.lens == straight.lens
    assert (lying.read_uint8() == straight.read_uint8()).all()
    assert (lying.read_file(30) == straight.read_file(30)).all()
    assert (lying.read_mask() == straight.read_mask()).all()


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_lying_photo_of_a_transforms_json_is_upright_with_its_camera(tmp_path, quarters):
    """The file's poses and lenses are of the pixels as stored."""
    stored, seen = tracked(), upright(tracked(), (60, 40), quarters)
    pixels = np.random.default_rng(0).integers(0, 256, (seen.height, seen.width, 3), dtype=np.uint8)
    store(tmp_path / "a.png", pixels, quarters)
    pose = np.linalg.inv(np.vstack([stored.camera_from_world, [0, 0, 0, 1]]))
    pose[:3, 1:3] *= -1  # OpenGL's axes
    frame = {"file_path": "a.png", "transform_matrix": pose.tolist()}
    lens = {"w": 60, "h": 40, "fl_x": LENS.fx, "fl_y": LENS.fy, "cx": LENS.cx, "cy": LENS.cy}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    capture = open_capture(tmp_path)
    (photo,), found = capture.photos, capture.reconstruction
    assert not capture.left_out and (photo.read_uint8().numpy() == pixels).all()
    plain = turned_lens(replace(LENS, distortion=()), quarters)
    assert photo.lens == plain and found.photos["a.png"].lens == plain
    np.testing.assert_allclose(found.photos["a.png"].camera_from_world, seen.camera_from_world, atol=1e-9)


@pytest.mark.parametrize("quarters", [1, 3])
@pytest.mark.parametrize("drawn", ["upright", "lying"])
def test_masks_and_labels_may_be_drawn_on_either(tmp_path, quarters, drawn):
    mask = np.zeros((60, 40), np.uint8)
    mask[5:20, 10:15] = 255
    store(tmp_path / "lying.png", np.zeros((60, 40, 3), np.uint8), quarters)
    on_file = mask if drawn == "upright" else np.ascontiguousarray(np.rot90(mask, quarters))
    Image.fromarray(on_file).save(tmp_path / "mask.png")
    lens = replace(turned_lens(LENS, 1), distortion=())
    photo = Photo("a", tmp_path / "lying.png", tmp_path / "mask.png", lens, quarters)
    assert np.array_equal(photo.read_mask(), mask > 0)
    import torch

    assert np.array_equal(photo.undistort_labels(torch.from_numpy(on_file).long()), mask)


def test_a_model_of_photos_that_were_turned_before_is_left_as_it_is(tmp_path):
    store(tmp_path / "lying.png", np.zeros((40, 60, 3), np.uint8), 1)  # 40 wide and 60 high as stored
    assert stored_size(tmp_path / "lying.png", "a") == ((40, 60), 1)
    found = upright(tracked(), *stored_size(tmp_path / "lying.png", "lying"))
    assert found.lens == LENS and found.quarter_turns == 1
    photo = Photo.from_model(found, tmp_path / "lying.png")
    assert photo.read_uint8().shape == (40, 60, 3)


def test_damaged_exif_turns_nothing(tmp_path):
    Image.new("RGB", (60, 40)).save(tmp_path / "a.jpg", exif=b"Exif\0\0MM\0*damaged")
    assert stored_size(tmp_path / "a.jpg", "a") == ((60, 40), 0)


@pytest.mark.parametrize(("given", "fy"), [({}, 1.0), ({"camera_angle_y": 0.8}, 0.75)])
def test_an_angle_of_view_along_y_makes_pixels_that_are_not_square(given, fy, tmp_path):
    Image.fromarray(np.zeros((120, 160, 3), np.uint8)).save(tmp_path / "a.png")
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    content = {"camera_angle_x": 0.8, **given, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    (photo,) = open_capture(tmp_path).photos
    assert photo.lens.fy == pytest.approx(fy * photo.lens.fx)
    (tmp_path / "transforms.json").write_text(json.dumps({**content, "k1": 0.1, "k4": 0.3}))
    with pytest.raises(UserError, match=r"a\.png has a OPENCV camera with k4, of another model"):
        open_capture(tmp_path)
