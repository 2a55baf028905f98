"""Folders as programs leave them: wherever model, photos and masks lie, the capture is the same one."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import write_scene, write_transforms

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.capture import open_capture
from lang3dxl_ns.scene.layout import find_model, mention_other_cameras
from lang3dxl_ns.scene.photo_folder import find_photos


@pytest.fixture(scope="module")
def stock(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("stock") / "scene", photos=3, points=30, size=(48, 36))


@pytest.fixture
def scene(stock, tmp_path):
    return Path(shutil.copytree(stock, tmp_path / "scene"))


def moved(scene, moves):
    for old, new in moves.items():
        (scene / new).parent.mkdir(parents=True, exist_ok=True)
        (scene / old).rename(scene / new)
    if not any((scene / "sparse").iterdir()):
        (scene / "sparse").rmdir()


def poses(capture):
    return {Path(p.name).name: p.camera_from_world.tolist() for p in capture.reconstruction.photos.values()}


@pytest.mark.parametrize(
    "moves",
    [
        {"sparse/0": "sparse/1"},
        {"sparse/0": "0"},
        {"sparse/0": "model"},
        {"sparse/0": "colmap_text"},
        {"sparse/0": "distorted/sparse/0", "images": "input"},
        {"sparse/0": "dense/0/sparse", "images": "dense/0/images"},
        {"sparse/0": "undistorted/sparse", "images": "undistorted/images"},
        {"images": "images_4"},
        {"sparse/0": "gaussian_splat/sparse/0", "images": "gaussian_splat/images_4"},
        {"images": "input"},
    ],
)
def test_the_model_and_its_photos_are_found_where_programs_leave_them(stock, scene, moves, capsys):
    moved(scene, moves)
    capture = open_capture(scene, may_reconstruct=False)
    assert poses(capture) == poses(open_capture(stock)) and not capture.left_out
    if "sparse/0" in moves:
        assert f"a COLMAP model in {moves['sparse/0']}, which is used" in capsys.readouterr().out


def test_photos_of_an_undistorted_model_lie_beside_it(scene):
    moved(scene, {"sparse/0": "dense/sparse"})
    shutil.copytree(scene / "images", scene / "dense" / "images")
    assert open_capture(scene, may_reconstruct=False).images == scene / "dense" / "images"


@pytest.mark.parametrize(
    ("images", "cameras", "data"),
    [
        ("images", "transforms.json", "images"),
        ("images_4", "transforms.json", "."),
        ("export/images", "export/transforms.json", "."),
        ("nerfstudio/images_8", "nerfstudio/transforms.json", "."),
    ],
)
def test_cameras_of_a_transforms_json_are_found_from_any_folder_of_its_scene(
    stock, scene, images, cameras, data, capsys
):
    write_transforms(scene, w=48, h=36)
    shutil.rmtree(scene / "sparse")
    for old, new in (("images", images), ("transforms.json", cameras)):
        (scene / new).parent.mkdir(exist_ok=True)
        (scene / old).rename(scene / new)
    found = open_capture(scene / data, may_reconstruct=False)
    assert found.source == scene / cameras and not found.left_out
    assert list(poses(found)) == list(poses(open_capture(stock)))
    assert (data == "." and cameras == "transforms.json") or str(scene) in capsys.readouterr().out


def test_a_transforms_json_below_other_photos_is_not_theirs(scene):
    write_transforms(scene, w=48, h=36)
    shutil.rmtree(scene / "sparse")
    for name in ("one", "two"):
        shutil.copytree(scene / "images", scene / name / "images")
        shutil.copy(scene / "transforms.json", scene / name)
    (scene / "transforms.json").unlink()
    for gone in ("two", "one/transforms.json"):  # two scenes; one, and other photos
        with pytest.raises(UserError, match="no COLMAP model"):
            open_capture(scene, may_reconstruct=False)
        shutil.rmtree(scene / gone, ignore_errors=True)


def test_of_several_models_the_largest_is_used_and_the_others_are_told(scene, capsys):
    write_scene(scene / "small", photos=2, points=30, size=(48, 36))
    shutil.move(scene / "small/sparse/0", scene / "sparse/1")
    moved(scene, {"sparse/0": "sparse/2"})
    shutil.rmtree(scene / "small")
    assert len(open_capture(scene, may_reconstruct=False).photos) == 3
    assert "sparse/1 with 2, sparse/2 with 3" in capsys.readouterr().out
    assert len(open_capture(scene / "sparse/1", may_reconstruct=False).photos) == 2
    assert "used is sparse/1 with 2 photos" in (said := capsys.readouterr().out)
    assert "sparse/2 with 3: to use one of them, give its folder" in said


@pytest.mark.parametrize("part", ["sparse/0", "images"])
def test_a_part_of_a_scene_means_the_scene(stock, scene, part, capsys):
    assert poses(open_capture(scene / part)) == poses(open_capture(stock))
    assert "is a part of the scene" in capsys.readouterr().out


def test_photos_called_images_without_a_model_above_stay_what_they_are(scene):
    shutil.rmtree(scene / "sparse")
    with pytest.raises(UserError, match=r"no COLMAP model in .*images/sparse/0"):
        open_capture(scene / "images", may_reconstruct=False)


@pytest.mark.parametrize("place", ["Masks/{}.png", "images/mask/{}.png", "images/.masks/{}.jpg.mask.png"])
@pytest.mark.parametrize("beside", [None, "{}_mask.png", "{}.jpg.mask.png", "mask_{}.png", "{}-mask.jpg"])
def test_masks_are_found_in_folders_of_any_spelling_and_beside_photos(scene, place, beside):
    form = place if beside is None else f"images/{beside}"
    for photo in list((scene / "images").iterdir()):
        mask = np.zeros((36, 48), np.uint8)
        mask[:, 12:] = 255
        (path := scene / form.format(photo.stem)).parent.mkdir(exist_ok=True)
        Image.fromarray(mask).save(path)
    capture = open_capture(scene)
    assert [float(photo.read_mask().float().mean()) for photo in capture.photos] == [0.75] * 3
    assert len(find_photos(scene).names) == 3  # a reconstruction takes no mask for a photo


def test_photos_whose_names_only_look_like_masks_are_photos(scene):
    (scene / "images" / "photo_000.jpg").rename(scene / "images" / "lion_mask.jpg")
    assert "lion_mask.jpg" in find_photos(scene).names
    assert open_capture(scene).photos[0].mask_path is None


@pytest.mark.parametrize("folder", ["@eaDir/photo_000.jpg", "#recycle", "$RECYCLE.BIN", "confidence"])
def test_thumbnails_trash_and_confidences_are_no_photos(scene, folder):
    (scene / "images" / folder).mkdir(parents=True)
    shutil.copy(scene / "images" / "photo_000.jpg", scene / "images" / folder / "thumb.jpg")
    assert len(find_photos(scene).names) == 3


def test_a_scene_of_blender_is_one_capture_with_its_split(scene):
    pose = np.eye(4)
    for part, photo in zip(("train", "val", "test"), sorted((scene / "images").iterdir()), strict=True):
        (scene / part).mkdir()
        Image.open(photo).convert("RGBA").save(scene / part / "r_0.png")
        frames = [{"file_path": f"./{part}/r_0", "rotation": 0.01, "transform_matrix": pose.tolist()}]
        content = {"camera_angle_x": 0.8 if part == "train" else 0.4, "frames": frames}
        (scene / f"transforms_{part}.json").write_text(json.dumps(content))
        pose[0, 3] += 1
    shutil.rmtree(scene / "sparse")
    shutil.rmtree(scene / "images")
    for data in (scene, scene / "transforms_train.json"):
        capture = open_capture(data)
        assert capture.names == ["test/r_0.png", "train/r_0.png", "val/r_0.png"]
        assert capture.split == (("train/r_0.png",), ("test/r_0.png", "val/r_0.png"))
        wide = {photo.name: photo.lens.fx for photo in capture.photos}
        assert wide["train/r_0.png"] < wide["val/r_0.png"] == wide["test/r_0.png"]


@pytest.mark.parametrize("suffix", ["", ".png"])
@pytest.mark.parametrize("left", ["no test photos", "no test frames", "training's frames"])
def test_photos_of_blender_are_trained_on_whatever_is_there_of_the_test(scene, suffix, left, capsys):
    """Exporters write no test photos, and other readers ask for a file of test photos, be it a copy."""
    top, pose = {"camera_angle_x": 0.8}, np.eye(4)
    for part in ("train", "test"):
        frames = []
        for i in range(2):
            pose[0, 3] += 1
            frames += [{"file_path": f"./{part}/r_{i}{suffix}", "transform_matrix": pose.tolist()}]
            if part == "train":
                (scene / "train").mkdir(exist_ok=True)
                Image.new("RGB", (48, 36)).save(scene / "train" / f"r_{i}.png")
        kept = (
            {"no test frames": [], "training's frames": None}.get(left, frames) if part == "test" else frames
        )
        if kept is not None:
            (scene / f"transforms_{part}.json").write_text(json.dumps(top | {"frames": kept}))
        else:
            shutil.copy(scene / "transforms_train.json", scene / "transforms_test.json")
    shutil.rmtree(scene / "sparse")
    shutil.rmtree(scene / "images")
    capture = open_capture(scene, may_reconstruct=False)
    assert capture.split == (("train/r_0.png", "train/r_1.png"),) * 2
    assert [photo.camera_from_world[0, 3] for photo in capture.reconstruction.photos.values()] == [-1, -2]
    assert ("hold out no photo" in capsys.readouterr().out) == (left != "training's frames")
    (scene / "transforms_test.json").write_text("{")
    with pytest.raises(UserError, match=r"transforms_test\.json can't be used"):
        open_capture(scene, may_reconstruct=False)


def test_cameras_that_are_not_read_are_named(scene, capsys):
    mention_other_cameras(scene)
    assert not capsys.readouterr().out
    (scene / "castle.xml").write_text("<document/>")
    (scene / "castle.csv").write_text("#name,x,y,alt,heading,pitch,roll\n")
    mention_other_cameras(scene)
    told = capsys.readouterr().out
    assert "castle.xml holds cameras of Metashape" in told and "castle.csv holds cameras of Real" in told
    (scene / "transform.json").write_text(json.dumps({"frames": [{"transform_matrix": []}]}))
    (scene / "notes.json").write_text("{}")
    mention_other_cameras(scene)
    assert "transform.json holds cameras, too" in (told := capsys.readouterr().out)
    assert "notes" not in told


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xmp", '<x xmlns:crs="camera-raw"/>'),
        ("metadata.json", '{"title": "Rome"}'),
        ("a.xml", "<plist/>"),
        ("a.csv", "photo,place\n"),
    ],
)
def test_notes_of_photo_editors_and_archives_are_no_cameras(scene, capsys, name, content):
    (scene / name).write_text(content)
    mention_other_cameras(scene)
    assert not capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "content", "program"),
    [
        ("a.xmp", '<x xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"/>', "RealityScan"),
        ("metadata.json", '{"poses": []}', "Record3D"),
    ],
)
def test_cameras_under_names_that_others_have_too_are_named(scene, capsys, name, content, program):
    (scene / "0.xmp").write_text("<x/>")
    (scene / name).write_text(content)
    mention_other_cameras(scene)
    assert f"{name} holds cameras of {program}" in " ".join(capsys.readouterr().out.split())


def test_a_list_of_addresses_among_photos_is_no_model(tmp_path):
    (tmp_path / "images.txt").write_text("https://example.org/a.jpg")
    assert find_model(tmp_path) is None
    (tmp_path / "points3D.txt").touch()
    assert find_model(tmp_path) == tmp_path  # of which a part is missing
