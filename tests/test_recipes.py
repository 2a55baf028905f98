"""The recipes of docs/python.md, on a scene with known answers."""

import re
from pathlib import Path

import numpy as np
import pytest
from painted_scene import DISTANCE, DOME, painted_gaussians, painted_scene
from PIL import Image

from lang3dxl_ns.plugin import load_scene as loading

PAGE = (Path(__file__).parents[1] / "docs" / "python.md").read_text()
RECIPES = dict(re.findall(r"^## (\d+)\..*?```python\n(.*?)```", PAGE, re.MULTILINE | re.DOTALL))


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Runs a recipe after the first, in an empty folder; returns its variables."""
    monkeypatch.setattr(loading, "load_scene", lambda run=None: painted_scene())
    monkeypatch.chdir(tmp_path)

    def run(number: int) -> dict:
        names: dict = {}
        for code in (RECIPES["1"], RECIPES[str(number)]):
            exec(code, names)
        return names

    return run


def test_there_are_ten_recipes():
    assert list(RECIPES) == [str(i) for i in range(1, 11)]


def test_1_a_scene_says_what_it_is(run):
    assert repr(run(1)["scene"]).startswith("Scene(5,185 Gaussians, 4 photos (1 held out)")


def test_2_poses_are_arrays(run, capsys):
    photo = run(2)["photo"]
    assert photo.pose.shape == (4, 4) and "held/0004.jpg eval [ 0.5  0.5 -5. ]" in capsys.readouterr().out


def test_3_a_rendering_has_the_size_asked_for(run):
    names = run(3)
    assert names["pixels"].shape == (640, 640, 3) and names["pixels"].dtype == np.uint8
    assert np.asarray(Image.open("rendering.png")).shape == (640, 640, 3)
    assert np.median(names["depth"]) == pytest.approx(DISTANCE, rel=1e-3)


def test_4_a_pose_of_ones_own_moves_the_camera(run):
    scene = run(4)["scene"]
    there = np.asarray(Image.open("aside.png")).astype(int)
    here = scene.render(scene.photos[0].pose, size=320).pixels.astype(int)
    moved = round(0.1 / DISTANCE * 320)
    assert np.abs(there[:, :-moved] - here[:, moved:]).mean() < 0.2 * np.abs(there - here).mean()


def test_5_a_match_is_saved_as_picture_and_as_numbers(run):
    match = run(5)["match"]
    assert match.mask.any() and not match.view.image.requires_grad
    np.testing.assert_array_equal(np.load("dome.npy"), match.relevancy.numpy())
    np.testing.assert_array_equal(np.asarray(Image.open("dome.png")), match.overlay())


def test_6_the_view_chosen_shows_the_word(run):
    match = run(6)["match"]
    assert match.view.name == "left/0001.jpg" and match.score > 0.5


def test_7_each_word_has_its_color(run):
    matches = run(7)["matches"]
    picture = np.asarray(Image.open("words.png")).astype(int)
    height = matches[0].view.camera.height
    for match, channel in zip(matches, (0, 2), strict=True):  # red, then blue
        place = match.mask.numpy()
        assert place.any() and (picture[:height][place].argmax(1) == channel).all()
    assert picture.shape[0] > height and (picture[height:] < 100).any()  # words below


def test_8_a_higher_threshold_leaves_less(run):
    scene = run(1)["scene"]
    names = {"scene": scene, "match": scene.query("dome", "0003.jpg")[0]}
    exec(RECIPES["8"], names)
    assert names["sure"].threshold == 0.6
    strict = scene.query("dome", "0003.jpg", threshold=0.9999)[0]
    assert not strict.mask.any() and names["sure"].mask.any()


def test_9_the_box_is_where_the_dome_is(run):
    box = run(9)["found"].box
    expected = np.array([DOME[0], DOME[2], 0.0, DOME[1], DOME[3], 0.0])
    np.testing.assert_allclose([*box.low, *box.high], expected, atol=0.15)


def test_10_the_gaussians_that_match_are_the_domes(run):
    names = run(10)
    count = int((painted_gaussians()["words"] == 1).sum())
    assert len(names["domes"]) == count and names["domes"].means.shape == (count, 3)
    assert f"element vertex {count}\n".encode() in Path("dome.ply").read_bytes()
    assert b"element vertex 5185\n" in Path("all.ply").read_bytes()
