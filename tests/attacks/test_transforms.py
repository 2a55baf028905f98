"""A transforms.json of a stranger: checked as COLMAP models are."""

import json
import math
import os
import re

import pytest
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.capture import open_capture

PLY = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {a}\n" for a in "xyz")
PLY += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n1 2 3 9 8 7\n"
POSE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]


@pytest.fixture
def folder(tmp_path):
    """A scene's folder, beside a picture that is not the scene's."""
    (tmp_path / "scene" / "images").mkdir(parents=True)
    for path in ("scene/images/a.png", "secret.png"):
        Image.new("RGB", (40, 30)).save(tmp_path / path)
    return tmp_path / "scene"


def write(folder, text=None, top=None, **frame):
    whole = {"file_path": "images/a.png", "transform_matrix": POSE}
    content = {"camera_model": "OPENCV", "w": 40, "h": 30, "fl_x": 50.0, "fl_y": 51.0, "cx": 20.0, "cy": 15.0}
    content |= {"frames": [whole | frame]} | (top or {})
    (folder / "transforms.json").write_text(json.dumps(content) if text is None else text)
    return folder


def test_a_sound_scene_passes_and_one_without_points_is_told(folder, capsys):
    open_capture(write(folder))
    assert "names no points" in capsys.readouterr().out
    (folder / "points.ply").write_text(PLY)
    found = open_capture(write(folder, top={"ply_file_path": "points.ply"}))
    assert found.reconstruction.points.tolist() == [[1, 2, 3]] and not capsys.readouterr().out
    open_capture(write(folder, file_path=str(folder / "images" / "a.png")))
    os.symlink(folder / "images", folder / "linked")
    open_capture(write(folder, file_path="linked/a.png"))


@pytest.mark.parametrize(
    "frame",
    [
        {"transform_matrix": [[math.nan] * 4] * 4},
        {"transform_matrix": [[0.0] * 4] * 4},
        {"transform_matrix": POSE[:2]},
        {"transform_matrix": None},
        *({"fl_x": value} for value in (-50.0, 0, math.nan, "50", 10**400)),
        *({"w": value} for value in (0, -40, math.nan, 10**7, "a", True)),
        {"k1": math.nan},
        {"file_path": None},
        {"file_path": 3},
        {"transform_matrix": [[2.0, 0, 0, 0], *POSE[1:]]},
        {"transform_matrix": [[-1.0, 0, 0, 0], *POSE[1:]]},
        {"transform_matrix": [list(row) for row in zip(*POSE, strict=True)]},
        {"distortion_params": [0, 0, 0, 0, "a", 0]},
    ],
)
def test_frames_that_nothing_can_be_rendered_from_are_named(folder, frame):
    with pytest.raises(UserError, match=r"transforms\.json can't be used"):
        open_capture(write(folder, **frame))


def test_null_is_no_value(folder):
    """Capture apps write null for what they don't know."""
    (photo,) = open_capture(write(folder, fl_x=None, mask_path=None, camera_model=None)).photos
    assert (photo.lens.fx, photo.lens.fy) == (50.0, 51.0)
    with pytest.raises(UserError, match="has no 'fl_x or camera_angle_x'"):
        open_capture(write(folder, top={"fl_x": None, "fl_y": None}))
    with pytest.raises(UserError, match=r"its camera_angle_x is 4\.0"):
        open_capture(write(folder, top={"fl_x": None, "fl_y": None}, camera_angle_x=4.0))


@pytest.mark.parametrize(("model", "key"), [("OPENCV", "k4"), ("OPENCV_FISHEYE", "p1")])
def test_distortion_of_another_model_than_the_cameras_is_refused(folder, model, key):
    open_capture(write(folder, camera_model=model, **{key: 0}))
    with pytest.raises(UserError, match=f"a {model} camera with {key}, of another model"):
        open_capture(write(folder, camera_model=model, **{key: 0.1}))


@pytest.mark.parametrize("key", ["file_path", "mask_path"])
@pytest.mark.parametrize("name", ["../secret.png", "/etc/hostname", "a\0b", "..", "images", "~/secret.png"])
def test_names_that_lead_outside_or_nowhere_are_named_and_never_opened(folder, key, name):
    with pytest.raises(UserError, match="none of the 1 photos"):
        open_capture(write(folder, **{key: name}))


@pytest.mark.parametrize("frame", [{"file_path": "images/a"}, {"transform_matrix": POSE[:3]}])
def test_what_other_programs_leave_out_is_understood(folder, frame):
    (photo,) = open_capture(write(folder, **frame)).photos
    assert photo.name == "images/a.png"


@pytest.mark.parametrize("key", ["file_path", "mask_path"])
def test_links_that_lead_outside_are_refused(folder, key):
    os.symlink(folder.parent / "secret.png", folder / "images" / "link.png")
    with pytest.raises(UserError, match="leads out of"):
        open_capture(write(folder, **{key: "images/link.png"}))


@pytest.mark.parametrize(
    "top",
    [
        {"frames": []},
        {"frames": None},
        {"frames": [3]},
        {"ply_file_path": "../secret.ply"},
        {"ply_file_path": 3},
        {"train_filenames": ["../secret.png"]},
        {"applied_scale": 0},
        {"applied_transform": [[math.nan] * 4] * 3},
    ],
)
def test_scenes_that_are_none_are_named(folder, top):
    with pytest.raises(UserError, match=r"transforms\.json can't be used"):
        open_capture(write(folder, top=top))


@pytest.mark.parametrize("text", ["", "\x00\xff", "null", "[]", "3", "[" * 100_000])
def test_files_that_are_no_json_are_named(folder, text):
    with pytest.raises(UserError, match=r"transforms\.json can't be used"):
        open_capture(write(folder, text=text))


@pytest.mark.parametrize("model", ["NOSUCH", ["OPENCV"], "EQUIRECTANGULAR", "ORTHOPHOTO"])
def test_unknown_camera_models_are_told_by_name(folder, model):
    with pytest.raises(UserError, match=re.escape(f"has a {model} camera")):
        open_capture(write(folder, top={"camera_model": model}))


def test_masks_that_are_pipes_are_refused_instead_of_waited_for(folder):
    os.mkfifo(folder / "images" / "pipe.png")
    with pytest.raises(UserError, match="none of the 1 photos"):
        open_capture(write(folder, mask_path="images/pipe.png"))


def test_a_list_of_photos_that_are_not_there_is_told(folder):
    with pytest.raises(UserError, match=r"train_filenames names .*other"):
        open_capture(write(folder, top={"train_filenames": ["images/other.png"]}))


def test_a_byte_order_mark_is_passed_over(folder):
    write(folder)
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text, encoding="utf-8-sig")
    assert len(open_capture(folder).photos) == 1


@pytest.mark.parametrize("name", ["images/a", "./images/a.png", ".//images/a", "images/../images/a.png"])
def test_a_splats_photos_are_found_without_suffix_and_by_every_relative_name(folder, name):
    (photo,) = open_capture(folder_of(folder, name)).photos
    assert photo.name == "images/a.png"


@pytest.mark.parametrize(("name", "file"), [("images/b.2020", "b.2020.JPEG"), ("images/c", "c.webp")])
def test_names_with_dots_and_large_suffixes_are_found(folder, name, file):
    Image.new("RGB", (40, 30)).save(folder / "images" / file)
    (photo,) = open_capture(folder_of(folder, name)).photos
    assert photo.name == f"images/{file}"


def folder_of(folder, name):
    """A scene whose only photo has this name in its transforms.json."""
    write(folder, file_path=name)
    return folder


@pytest.mark.parametrize("fisheye", [True, False])
def test_lenses_of_instant_ngp_are_fisheyes_where_it_says_so(folder, fisheye):
    write(folder, is_fisheye=fisheye, k1=0.1)
    (photo,) = open_capture(folder).photos
    assert photo.lens.fisheye == fisheye and photo.lens.distortion[0] == 0.1


@pytest.mark.parametrize("key", ["equirectangular", "latlong", "orthographic", "ftheta_p0"])
def test_other_lenses_of_instant_ngp_are_refused(folder, key):
    with pytest.raises(UserError, match=f"has a {key} camera"):
        open_capture(write(folder, top={key: 1}))


@pytest.mark.parametrize("times", [2, 3])
@pytest.mark.parametrize("form", ["images/a.png", "./images/a.png"])
def test_a_photo_that_is_listed_again_counts_once_if_its_camera_is_the_same(folder, times, form):
    write(folder)
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"] += [content["frames"][0] | {"file_path": form}] * (times - 1)
    (folder / "transforms.json").write_text(json.dumps(content))
    found = open_capture(folder)
    assert found.names == ["images/a.png"] and not found.left_out
    content["frames"][1] = content["frames"][1] | {"fl_x": 60.0}
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"correct .*transforms\.json.*twice, with other cameras"):
        open_capture(folder)


def test_training_refuses_such_a_scene(folder, train):
    write(folder, fl_x=-50.0)
    with pytest.raises(UserError, match=r"transforms\.json can't be used.*focal"):
        train(folder, semantics=False)
