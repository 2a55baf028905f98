"""Scene files with wrong contents: one line that names the file."""

import json
import math

import pytest

from lab.landmark.novel_views import read_novel_views
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.needs import NEEDS_FILE, read_needs
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord

POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0]]


def scene_file(folder, change):
    photos = [
        ScenePhoto(f"photo_{i}.jpg", "train", POSE, Lens(40, 30, 50.0, 51.0, 20.0, 15.0)) for i in range(2)
    ]
    path = folder / "scene.json"
    SceneRecord(photos, "clip", "identity", 1.0, POSE, "data").write(path)
    content = json.loads(path.read_text())
    SceneRecord.read(path)
    change(content)
    path.write_text(json.dumps(content))
    return path


def set_of_photo(name, value):
    return lambda content: content["photos"][1].update({name: value})


def set_of_lens(name, value):
    return lambda content: content["photos"][1]["lens"].update({name: value})


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.update(photos=[]),
        lambda content: content.update(photos={}),
        lambda content: content.update(photos=[1]),
        lambda content: content.update(photos=content["photos"][:1] * 2),
        lambda content: content.update(scale="1"),
        lambda content: content.update(scale=0),
        lambda content: content.update(scale=math.nan),
        lambda content: content.update(transform=POSE[:2]),
        lambda content: content.update(transform=[["a"] * 4] * 3),
        lambda content: content.update(clip=3),
        lambda content: content.update(data=None),
        set_of_photo("name", 3),
        set_of_photo("name", ""),
        *(
            set_of_photo("name", name)
            for name in ("/etc/x", "..", "a/../../b", ".", "/", "a\0b", "a\n", "\x1b[2J")
        ),
        set_of_photo("name", "\ud800"),
        set_of_photo("camera_to_world", [[0.0] * 4] * 3),
        set_of_photo("camera_to_world", [[1e29] * 4] * 3),
        set_of_photo("split", "none"),
        set_of_photo("mask", 5),
        set_of_photo("camera_to_world", POSE[0]),
        set_of_photo("camera_to_world", [[math.nan] * 4] * 3),
        set_of_photo("camera_to_world", [[True] * 4] * 3),
        set_of_lens("width", 0),
        set_of_lens("width", -40),
        set_of_lens("width", 40.5),
        set_of_lens("width", "40"),
        set_of_lens("height", 2_000_000),
        set_of_lens("fx", 0),
        set_of_lens("fx", math.inf),
        set_of_lens("cx", None),
        set_of_lens("distortion", [1.0]),
        set_of_lens("distortion", 3),
        set_of_lens("distortion", ["a"] * 4),
        set_of_lens("fisheye", 2),
    ],
)
def test_a_scene_file_with_something_of_another_kind_is_named(tmp_path, change):
    path = scene_file(tmp_path, change)
    with pytest.raises(UserError, match=r"scene\.json can't be read"):
        SceneRecord.read(path)


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "", "null", "[]", "{}", "\x00", '{"version": 2}', '{"version": 1, "photos": [{}]}'],
)
def test_a_scene_file_that_is_none_is_named(tmp_path, text):
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(UserError, match=r"scene\.json can't be read"):
        SceneRecord.read(tmp_path / "scene.json")


@pytest.mark.parametrize("text", ["[" * 100_000, "", "[1]", '{"a": 1}', '{"a": {}}', "\xff"])
def test_damaged_needs_of_a_run_are_named(tmp_path, text):
    assert read_needs(tmp_path) == {}
    (tmp_path / f"{NEEDS_FILE}.json").write_text(text)
    with pytest.raises(UserError, match=rf"{NEEDS_FILE}\.json can't be read"):
        read_needs(tmp_path)


@pytest.mark.parametrize(
    "change",
    [{}, {"width": 10**9}, {"width": "a"}, {"intrinsics": [math.nan] * 4}, {"points": 3}, {"points": [[1]]}],
)
def test_damaged_test_views_are_named(tmp_path, change):
    view = {"name": "../../a.png", "width": 40, "height": 30, "intrinsics": [50, 51, 20, 15]}
    view |= {"camera_from_world": POSE, "points": [[0, 0, 1.0]]} | change
    (tmp_path / "test_views").mkdir()
    path = tmp_path / "test_views" / "cameras.json"
    path.write_text(json.dumps({"same_light": True, "views": [view] if change else view}))
    with pytest.raises(UserError, match=r"cameras\.json is damaged"):
        read_novel_views(tmp_path)


def test_poses_written_as_integers_are_poses(tmp_path):
    whole = [[int(value) for value in row] for row in POSE]
    path = scene_file(tmp_path, set_of_photo("camera_to_world", whole))
    assert SceneRecord.read(path).photos[1].camera.view_matrix.is_floating_point()
