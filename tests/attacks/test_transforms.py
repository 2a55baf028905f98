"""A transforms.json of a stranger: checked as COLMAP models are, before nerfstudio reads it."""

import json
import math
import os

import pytest
from lang3dxl_ns.preparation.photo_collection import read_collection
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.nerfstudio_scenes import check_transforms

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
    return NerfstudioDataParserConfig(data=folder)


def test_a_sound_scene_passes_and_one_without_points_is_told(folder, capsys):
    check_transforms(write(folder))
    assert "names no points" in capsys.readouterr().out
    (folder / "points.ply").write_text("ply")
    check_transforms(write(folder, top={"ply_file_path": "points.ply"}))
    assert not capsys.readouterr().out
    check_transforms(write(folder, file_path=str(folder / "images" / "a.png")))
    os.symlink(folder / "images", folder / "linked")
    check_transforms(write(folder, file_path="linked/a.png"))


@pytest.mark.parametrize(
    "frame",
    [
        {"transform_matrix": [[math.nan] * 4] * 4},
        {"transform_matrix": [[0.0] * 4] * 4},
        {"transform_matrix": POSE[:2]},
        {"transform_matrix": None},
        *({"fl_x": value} for value in (-50.0, 0, math.nan, "50", None, 10**400)),
        *({"w": value} for value in (0, -40, math.nan, 10**7, "a", True)),
        {"k1": math.nan},
        {"file_path": None},
        {"file_path": 3},
        *({key: "../secret.png"} for key in ("file_path", "mask_path", "depth_file_path")),
        *({key: "/etc/hostname"} for key in ("file_path", "mask_path", "depth_file_path")),
        {"file_path": "a\0b"},
        {"file_path": "images/a"},
        {"transform_matrix": POSE[:3]},
        {"is_fisheye": True},
    ],
)
def test_frames_that_nothing_can_be_rendered_from_or_that_lead_outside_are_named(folder, frame):
    with pytest.raises(UserError, match=r"transforms\.json can't be used"):
        check_transforms(write(folder, **frame))


@pytest.mark.parametrize("key", ["file_path", "mask_path"])
def test_links_that_lead_outside_are_refused(folder, key):
    os.symlink(folder.parent / "secret.png", folder / "images" / "link.png")
    with pytest.raises(UserError, match="leads out of"):
        check_transforms(write(folder, **{key: "images/link.png"}))


@pytest.mark.parametrize(
    "top",
    [
        {"frames": []},
        {"frames": None},
        {"frames": [3]},
        {"camera_model": "NOSUCH"},
        {"camera_model": ["OPENCV"]},
        {"ply_file_path": "../secret.ply"},
        {"ply_file_path": 3},
        {"train_filenames": ["../secret.png"]},
        {"applied_scale": 0},
        {"applied_transform": [[math.nan] * 4] * 3},
    ],
)
def test_scenes_that_are_none_are_named(folder, top):
    with pytest.raises(UserError, match=r"transforms\.json can't be used"):
        check_transforms(write(folder, top=top))


@pytest.mark.parametrize("text", ["", "\x00\xff", "null", "[]", "3", "[" * 100_000])
def test_files_that_are_no_json_are_named(folder, text):
    with pytest.raises(UserError, match=r"transforms\.json can't be used"):
        check_transforms(write(folder, text=text))


def test_pipes_are_refused_instead_of_waited_for(folder):
    os.mkfifo(folder / "transforms.json")
    with pytest.raises(UserError, match="not a regular file"):
        check_transforms(NerfstudioDataParserConfig(data=folder))
    (folder / "transforms.json").unlink()
    os.mkfifo(folder / "images" / "pipe.png")
    with pytest.raises(UserError, match="not a regular file"):
        check_transforms(write(folder, mask_path="images/pipe.png"))


@pytest.mark.parametrize(
    "top", [{}, {"applied_transform": POSE}, {"train_filenames": ["images/other.png"]}]
)  # a single place, and two that only nerfstudio notices
def test_what_nerfstudio_can_not_read_is_one_sentence(folder, train, top):
    write(folder, top=top)
    with pytest.raises(UserError, match=r"nerfstudio can't read .*: make it again"):
        train(folder, semantics=False)


def test_a_byte_order_mark_is_one_sentence(folder, train):
    write(folder)
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text, encoding="utf-8-sig")
    with pytest.raises(UserError, match=r"nerfstudio can't read .*BOM"):
        train(folder, semantics=False)


@pytest.mark.parametrize("name", ["images/a", "./images/a.png", ".//images/a", "images/../images/a.png"])
def test_a_splats_photos_are_found_without_suffix_and_by_every_relative_name(folder, name):
    (photo,) = read_collection(folder_of(folder, name)).photos
    assert photo.name == "images/a.png"


@pytest.mark.parametrize(("name", "file"), [("images/b.2020", "b.2020.JPEG"), ("images/c", "c.webp")])
def test_names_with_dots_and_large_suffixes_are_found(folder, name, file):
    Image.new("RGB", (40, 30)).save(folder / "images" / file)
    (photo,) = read_collection(folder_of(folder, name)).photos
    assert photo.name == f"images/{file}"


def folder_of(folder, name):
    """A scene whose only photo has this name in its transforms.json."""
    write(folder, file_path=name)
    return folder


@pytest.mark.parametrize("fisheye", [True, False])
def test_lenses_of_instant_ngp_are_fisheyes_where_it_says_so(folder, fisheye):
    write(folder, is_fisheye=fisheye, k1=0.1)
    (photo,) = read_collection(folder).photos
    assert photo.lens.fisheye == fisheye and photo.lens.distortion[0] == 0.1


def test_training_refuses_such_a_scene(folder, train):
    write(folder, fl_x=-50.0)
    with pytest.raises(UserError, match=r"transforms\.json can't be used.*focal"):
        train(folder, semantics=False)
