"""The scene description in a run's folder."""

import json
from dataclasses import asdict, replace
from unicodedata import normalize

import numpy as np
import pytest
import torch
from painted_scene import painted_scene
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.camera import Lens, camera_to_world, posed, resized, view_matrix
from lang3dxl_ns.scene.photo import Photo, turned_lens
from lang3dxl_ns.scene.reconstruction import REPORT, ReconstructionReport, doubtful_photos
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord
from lang3dxl_ns.words.learn_word import _marks
from lang3dxl_ns.words.taught_words import Example, known_word


@pytest.fixture
def file():
    return painted_scene().file


def test_it_reads_what_it_wrote(file, tmp_path):
    file.write(tmp_path / "scene.json")
    assert SceneRecord.read(tmp_path / "scene.json") == file


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_mask_of_a_turned_photo_is_that_of_training(quarters, tmp_path):
    """Drawn on the pixels as they are stored."""
    upright = np.zeros((20, 30), np.uint8)
    upright[3:9, 4:6] = 255
    stored = np.rot90(upright, quarters) if quarters % 2 else upright
    Image.fromarray(np.ascontiguousarray(stored)).save(tmp_path / "mask.png")
    pose = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
    photo = ScenePhoto(
        "a", "train", pose, Lens(30, 20, 30, 30, 15, 10), f"{tmp_path}/mask.png", None, quarters
    )
    about = SceneRecord([photo], None, None, 1.0, [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]], "data")
    about.write(tmp_path / "scene.json")
    (found,) = SceneRecord.read(tmp_path / "scene.json").photos
    assert found == photo
    assert np.array_equal(found.foreground(), upright > 0)


@pytest.mark.parametrize("turns", [0, 1])
def test_marks_are_pixels_of_the_file_where_training_read_it_smaller(turns, tmp_path):
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(tmp_path / "a.png")
    lens = Lens(40, 30, 40, 40, 20, 15)
    upright = Photo("a", tmp_path / "a.png", None, turned_lens(lens, turns), turns)
    pose = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
    described = ScenePhoto.of(upright.at_most(20), "train", pose, 0.5)
    about = SceneRecord([described], None, None, 1.0, pose, "data")
    about.write(tmp_path / "scene.json")
    (photo,) = SceneRecord.read(tmp_path / "scene.json").photos
    assert photo == described
    width, height = photo.file_size
    assert (width, height) == ((30, 40) if turns else (40, 30))
    assert (photo.full_camera.width, photo.full_camera.height) == (width // 2, height // 2)
    marks = _marks(Example("a", box=(width - 6, 0, width, 4)), photo, (height // 2, width // 2))
    assert marks[0, :2, -3:].min() == 1 and marks[0].sum() == 6


def test_a_doubtful_place_is_kept_from_the_reconstruction_to_the_record(tmp_path):
    assert doubtful_photos(tmp_path, tmp_path) == {}
    report = ReconstructionReport(2, 2, 9, 0.5, 1, "incremental", doubtful={"a": "it looks away"})
    (tmp_path / REPORT).parent.mkdir()
    (tmp_path / REPORT).write_text(json.dumps(asdict(report)))
    pose, photo = torch.eye(4)[:3].tolist(), Photo("a", tmp_path / "a", None, Lens(30, 20, 30, 30, 15, 10))
    described = ScenePhoto.of(photo, "train", pose, 1.0, doubtful_photos(tmp_path, tmp_path).get("a"))
    SceneRecord([described], None, None, 1.0, pose, "data").write(tmp_path / "scene.json")
    assert SceneRecord.read(tmp_path / "scene.json").photos[0].doubtful == "it looks away"


def test_a_missing_file_is_explained(tmp_path):
    with pytest.raises(UserError, match="copy the whole folder"):
        SceneRecord.read(tmp_path / "scene.json")


@pytest.mark.parametrize("name", ["left/0001.jpg", "0001.jpg", "0001"])
def test_a_photo_goes_by_its_name_file_name_or_stem(file, name):
    assert file.photo(name).name == "left/0001.jpg"


@pytest.mark.parametrize(("stored", "typed"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_an_accent_is_the_same_in_its_letter_or_behind_it(file, stored, typed):
    own, asked = (normalize(form, "left/façade.jpg") for form in (stored, typed))
    named = replace(file, photos=[replace(file.photos[0], name=own), *file.photos[1:]])
    assert own != asked and named.photo(asked).name == named.photo(asked.split("/")[1]).name == own
    assert known_word(own) == known_word(asked)


def test_a_resized_camera_sees_the_same(file):
    camera = file.photos[0].camera
    small = resized(camera, 24)
    assert (small.width, small.height) == (24, 24)
    point = torch.tensor([0.3, 0.1, 1.0])
    big, tiny = camera.intrinsics @ point / 96, small.intrinsics @ point / 24
    torch.testing.assert_close(big[:2], tiny[:2])
    assert resized(camera, 1000).width == 96


def test_camera_to_world_is_the_inverse_of_the_view_matrix():
    generator = torch.Generator().manual_seed(0)
    pose = torch.cat(
        [torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q, torch.randn(3, 1, generator=generator)], 1
    )
    torch.testing.assert_close(camera_to_world(view_matrix(pose)), pose)


def test_a_posed_camera_has_the_lens_of_another(file):
    camera = file.photos[0].camera
    again = posed(camera_to_world(camera.view_matrix), like=camera)
    torch.testing.assert_close(again.view_matrix, camera.view_matrix)
    assert torch.equal(again.intrinsics, camera.intrinsics)
