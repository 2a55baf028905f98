"""The recipes of docs/python.md, one after the other, on a scene with known answers and on a trained run."""

import re
from pathlib import Path

import numpy as np
import pytest
from painted_scene import COUNT, DISTANCE, painted_gaussians, painted_scene
from PIL import Image
from runs import fitted

import lang3dxl_ns.open_scene as opening

PAGE = (Path(__file__).parents[1] / "docs" / "python.md").read_text()
RECIPES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def after(tmp_path_factory):
    """The variables after each recipe, from the first on, in an empty folder."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(opening, "load_scene", lambda path=None: painted_scene())
        patched.chdir(tmp_path_factory.mktemp("recipes"))
        names, states = {}, [{}]
        for code in RECIPES:
            exec(code, names)
            states.append(dict(names))
        yield states


def test_all_recipes_run_on_a_run_trained_by_the_suite(scene, tiny_clip, tiny_dense, tmp_path, monkeypatch):
    scene = fitted(scene, tiny_clip, tiny_dense, tmp_path / "run").scene()
    monkeypatch.setattr(opening, "load_scene", lambda path=None: scene)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for code in RECIPES:
        exec(code, names)


def test_1_a_scene_says_what_it_is(after):
    assert repr(after[1]["scene"]).startswith(f"Scene({COUNT:,} Gaussians, 4 photos (1 held out)")


def test_3_a_rendering_has_the_requested_size(after):
    assert after[3]["pixels"].shape == (640, 640, 3) and after[3]["pixels"].dtype == np.uint8
    assert np.asarray(Image.open("rendering.png")).shape == (640, 640, 3)
    assert np.median(after[3]["depth"][after[3]["view"].alpha > 0.5]) == pytest.approx(DISTANCE, rel=1e-3)


def test_4_a_pose_of_ones_own_moves_the_camera(after):
    scene = after[4]["scene"]
    there = np.asarray(Image.open("aside.png")).astype(int)
    here = scene.render(scene.photos[0].pose, size=320, fov=60).pixels.astype(int)
    moved = round(0.1 / DISTANCE * 320 / 2 / np.tan(np.radians(30)))
    assert np.abs(there[:, :-moved] - here[:, moved:]).mean() < 0.3 * np.abs(there - here).mean()


def test_5_a_match_is_saved_as_picture_and_as_numbers(after):
    match = after[5]["match"]
    np.testing.assert_array_equal(np.load("dome.npy"), match.relevancy)
    np.testing.assert_array_equal(np.asarray(Image.open("dome.png")), match.overlay())


def test_7_each_word_has_its_color(after):
    matches = after[7]["matches"]
    picture = np.asarray(Image.open("words.png")).astype(int)
    height = matches[0].view.camera.height
    place = matches[0].mask
    assert place.any() and (picture[:height][place].argmax(1) == 0).all()  # red
    assert picture.shape[0] > height and (picture[height:] < 100).any()  # words below


def test_8_a_higher_threshold_leaves_less(after):
    assert after[8]["sure"].threshold >= 0.6 and after[8]["sure"].mask.any()


def test_11_vectors_and_features_agree_with_words(after):
    assert after[11]["similar"].argmax() in np.flatnonzero(painted_gaussians()["words"] == 1)
