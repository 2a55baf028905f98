"""Captures as other programs leave them: each right value, from formulas."""

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import write_ply, write_transforms
from scipy.spatial.transform import Rotation

from lang3dxl_ns.attachment.learn import photos_of
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene import capture
from lang3dxl_ns.scene.capture import CaptureSettings, open_capture, recorded_capture
from lang3dxl_ns.scene.colmap import read_reconstruction
from lang3dxl_ns.scene.frame import Frame, find_frame, lost_cameras, wrong_cameras
from lang3dxl_ns.scene.names import name_finder, resolve
from lang3dxl_ns.scene.ply_points import read_ply_points
from lang3dxl_ns.scene.reconstruction import CONTRADICTED, LONELY, REPORT
from lang3dxl_ns.training.batches import TrainingData


def as_text(folder, images=None, points=None, cameras=None):
    """Turn the model into text files; functions change the lines of each."""
    import pycolmap

    model = folder / "sparse" / "0"
    found = pycolmap.Reconstruction(model)
    found.write_text(model)
    for path in model.glob("*.bin"):
        path.unlink()
    for name, change in (("images", images), ("points3D", points), ("cameras", cameras)):
        path = model / f"{name}.txt"
        if change is not None:
            path.write_text("\n".join(change(path.read_text().split("\n"))))
    return model


def firsts(lines):
    """The lines of images.txt that name photos."""
    return [line for line in lines if line.endswith(".png")]


# ── COLMAP's text files ─────────────────────────────────────────────────────────────────────────────────


def test_a_text_model_is_the_binary_one(folder):
    before = read_reconstruction(folder / "sparse" / "0")
    after = read_reconstruction(as_text(folder))
    assert list(before.photos) == list(after.photos)
    for a, b in zip(before.photos.values(), after.photos.values(), strict=True):
        np.testing.assert_allclose(a.camera_from_world, b.camera_from_world, atol=1e-9)
        np.testing.assert_allclose(a.points, b.points, atol=1e-9)
        np.testing.assert_allclose(a.pixels, b.pixels, atol=1e-3)
        assert a.lens == b.lens
    assert (before.colors == after.colors).all()


def without_second(lines):
    return firsts(lines)


def with_blank_lines(lines):
    return [part for line in lines for part in (line, "")]


def without_comments(lines):
    return [line for line in lines if not line.startswith("#")]


def with_mark(lines):
    return ["\ufeff" + lines[0], *lines[1:]]


def with_windows_ends(lines):
    return [line + "\r" for line in lines]


@pytest.mark.parametrize(
    "change", [without_second, with_blank_lines, without_comments, with_mark, with_windows_ends]
)
def test_images_txt_may_lack_lines_and_have_more(folder, change):
    tracked = {name: len(p.points) for name, p in read_reconstruction(folder / "sparse" / "0").photos.items()}
    found = read_reconstruction(as_text(folder, images=change)).photos
    assert list(found) == list(tracked)
    expected = dict.fromkeys(tracked, 0) if change is without_second else tracked
    assert {name: len(photo.points) for name, photo in found.items()} == expected


def test_names_have_spaces_and_photos_may_be_numbers(folder):
    for old, new in (("photo_000.png", "a b  c.png"), ("photo_001.png", "12")):
        (folder / "images" / old).rename(folder / "images" / new)
    change = lambda lines: [  # noqa: E731
        line.replace("photo_000.png", "a b  c.png").replace("photo_001.png", "12") for line in lines
    ]
    as_text(folder, images=change)
    assert {"a b  c.png", "12"} <= set(open_capture(folder).names)


def test_photos_may_be_removed_from_images_txt(folder):
    whole = len(read_reconstruction(folder / "sparse" / "0").points)

    def change(lines):
        gone = next(i for i, line in enumerate(lines) if line.endswith("photo_002.png"))
        return lines[:gone] + lines[gone + 2 :]

    found = read_reconstruction(as_text(folder, images=change))
    assert len(found.photos) == 5 and len(found.points) == whole


def test_points_may_lack_colors_and_tracks(folder, capsys):
    def change(lines):
        return [" ".join(line.split()[:4]) if line[:1] != "#" else line for line in lines]

    found = read_reconstruction(as_text(folder, points=change))
    assert (found.colors == 128).all() and len(found.points) > 0
    assert "no color" in capsys.readouterr().out


def test_keypoints_without_a_point_have_none_whatever_number_points_have(folder):
    points = lambda ls: [x if x[:1] == "#" else f"-1 {x.partition(' ')[2]}" for x in ls if x]  # noqa: E731
    images = lambda ls: [x if x[:1] == "#" or x.endswith("png") else "4 5 -1" for x in ls if x]  # noqa: E731
    found = read_reconstruction(as_text(folder, images, points))
    assert len(found.points) and not any(len(photo.points) for photo in found.photos.values())


@pytest.mark.parametrize(
    ("part", "change", "told"),
    [
        ("cameras", lambda ls: [x.replace("PINHOLE", "MAGIC") for x in ls], "camera model MAGIC"),
        ("cameras", lambda ls: [x.replace(" 96 ", " x ") for x in ls], r"cameras\.txt is not a camera"),
        ("cameras", lambda ls: [x + " 1" if x[:1] == "1" else x for x in ls], "has 4 parameters, not 5"),
        ("cameras", lambda ls: ["#"], "camera 1, which the COLMAP model lacks"),
        ("images", lambda ls: [x.partition(" photo")[0] for x in ls], "keypoints of no photo"),
        ("images", lambda ls: ls + firsts(ls)[:1], "twice"),
        ("images", lambda ls: ["1 2 3", *ls], "keypoints of no photo"),
        ("images", lambda ls: ["1 0 0 0 0 1 2 3 1 photo_000.png"], "no quaternion"),
        ("images", lambda ls: ["1 1 0 0 0 1,5 2 3 1 photo_000.png"], "neither a photo"),
        ("points", lambda ls: ["1 2 x 4"], r"points3D\.txt is not a point"),
    ],
)
def test_what_is_wrong_in_a_text_file_is_told_by_name(folder, part, change, told):
    model = as_text(folder, **{part: change})
    with pytest.raises(UserError, match=told):
        read_reconstruction(model)


def test_a_binary_model_may_name_removed_photos(folder):
    """As scripts leave it that remove photos from images.bin alone."""
    model = folder / "sparse" / "0"
    whole = (model / "images.bin").read_bytes()
    last = whole.rindex(b"photo_005.png") - 64
    (model / "images.bin").write_bytes(struct.pack("<Q", 5) + whole[8:last])
    assert len(read_reconstruction(model).photos) == 5


# ── names ───────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("images\\a.png", "a.png"),
        ("images/a.png", "a.png"),
        ("C:\\scans\\images\\A.PNG", "a.png"),
        ("/home/else/images/a.png", "a.png"),
        ("./../images/a.jpeg", "a.png"),
        ("a", "a.png"),
        ("day2/b.jpg", "day2/b.png"),
        ("caf\u0065\u0301.png", "caf\u00e9.png"),
        ("https://scans.org/caf%C3%A9.png", "caf\u00e9.png"),
        ("day2%2Fb.jpg", "day2/b.png"),
        ("50%25.png", "50%25.png"),
    ],
)
def test_names_of_other_programs_find_their_file(name, file):
    files = ["a.png", "day1/b.png", "day2/b.png", "caf\u00e9.png", "50%25.png", "50%.png"]
    assert name_finder(files)(name) == [file]
    assert name_finder(files)(f"%{'25' * 4000}.png") == []  # written so a thousand times over


def test_ambiguous_and_shared_names_are_refused_and_exact_ones_keep_their_files(capsys):
    files = ["day1/b.png", "day2/b.png", "c.png", "d.png", "e.png"]
    names = ["b.png", "x/c.jpg", "y/c.jpg", "d.png", "z/d.png", "E.PNG"]
    found, refused = resolve(names, files.__contains__, lambda: files, "photos")
    assert found == {"d.png": "d.png", "E.PNG": "e.png"}
    assert set(refused) == {"b.png", "x/c.jpg", "y/c.jpg"}
    assert "1 of 6 photos have other names than listed: E.PNG is e.png" in capsys.readouterr().out
    found, refused = resolve(["train/c", "test/c"], files.__contains__, lambda: ["train/c.png"], "photos")
    assert found == {"train/c": "train/c.png"} and set(refused) == {"test/c"}


def test_a_model_of_jpegs_finds_the_same_photos_as_png(folder):
    for path in (folder / "images").iterdir():
        path.rename(path.with_suffix(".PNG"))
    assert open_capture(folder).names == [f"photo_{i:03d}.PNG" for i in range(6)]


def test_a_name_is_not_ambiguous_for_files_that_are_never_read():
    files = ["r_0.png", "r_0.exr", "b.CR2", "b.jpg", "c.exr", "c.cr2"]
    found, refused = resolve(["images/r_0", "b", "c"], files.__contains__, lambda: files, "photos")
    assert found == {"images/r_0": "r_0.png", "b": "b.jpg"} and set(refused) == {"c"}


@pytest.mark.parametrize("setting", ["colmap_path", "images_path", "masks_path"])
@pytest.mark.parametrize("name", ["undistortd", "~/undistortd"])
def test_a_misspelled_part_of_a_scene_is_told_by_name(folder, setting, name):
    with pytest.raises(UserError, match="undistortd"):
        open_capture(folder, CaptureSettings(**{setting: Path(name)}))


@pytest.mark.parametrize("setting", ["images_path", "masks_path"])
def test_it_is_told_before_a_reconstruction(folder, setting, monkeypatch):
    monkeypatch.setattr(capture, "reconstruct_scene", lambda *_: pytest.fail("it begins"))
    shutil.rmtree(folder / "sparse")
    with pytest.raises(UserError, match="undistortd"):
        open_capture(folder, CaptureSettings(**{setting: Path("undistortd")}))


def test_photos_that_are_links_are_refused_before_they_are_reconstructed(folder, tmp_path, monkeypatch):
    """Training would leave out all of them after hours. One to nothing is left out like a damaged photo."""
    made = []
    monkeypatch.setattr(capture, "reconstruct_scene", lambda *given: made.append(given) or given)
    (tmp_path / "links").mkdir()
    for path in (folder / "images").iterdir():
        (tmp_path / "links" / path.name).symlink_to(path)
    with pytest.raises(UserError, match=r"photo_000.* leads out of .*links with --follow-links"):
        capture.find_source(tmp_path / "links", CaptureSettings())
    assert made == []
    capture.find_source(tmp_path / "links", CaptureSettings(follow_links=True))
    assert len(made) == 1
    shutil.rmtree(folder / "sparse")
    (folder / "images" / "gone.png").symlink_to(tmp_path / "gone.png")
    capture.find_source(folder, CaptureSettings())
    assert len(made) == 2


def test_a_link_to_nothing_is_no_photo_of_another_scenes_cache(folder, tmp_path):
    stamp = tmp_path / "cache" / REPORT.with_name("photos.json")
    stamp.parent.mkdir(parents=True)
    stamp.write_text(json.dumps({"photos": [["a.png", 1]]}))
    (folder / "images" / "gone.png").symlink_to(tmp_path / "gone.png")
    assert len(open_capture(folder, cache_dir=tmp_path / "cache").photos) == 6


# ── points ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(("kind", "full"), [("u1", 255), ("u2", 65535), ("f4", 1.0), ("f4", 255.0)])
def test_points_of_every_form_have_their_colors(tmp_path, form, kind, full):
    rows = [(1.5, 2, 3, full, 0, full), (4, 5, 6, 0, full, 0)]
    points, colors = read_ply_points(write_ply(tmp_path / "a.ply", form, ["f8"] * 3 + [kind] * 3, rows))
    assert points.tolist() == [[1.5, 2, 3], [4, 5, 6]]
    assert colors.tolist() == [[255, 0, 255], [0, 255, 0]]


def test_points_without_colors_are_gray(tmp_path, capsys):
    _, colors = read_ply_points(write_ply(tmp_path / "a.ply", "ascii", ["f4"] * 3, [(1.0, 2, 3)]))
    assert colors.tolist() == [[128, 128, 128]] and "no colors" in capsys.readouterr().out


HUGE = b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n"


@pytest.mark.parametrize("content", [b"", b"ply\n", b"ply\nformat ascii 1.0\nend_header\n", HUGE])
def test_damaged_points_are_named(tmp_path, content):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(UserError, match=r"the points of .*a\.ply can't be read"):
        read_ply_points(tmp_path / "a.ply")


# ── transforms.json ─────────────────────────────────────────────────────────────────────────────────────


def test_transforms_and_model_are_one_capture(folder):
    model = open_capture(folder)
    points = [(*p, *c) for p, c in zip(model.reconstruction.points, model.reconstruction.colors, strict=True)]
    write_ply(folder / "points.ply", "binary_little_endian", ["f8"] * 3 + ["u1"] * 3, points)
    write_transforms(folder, ply_file_path="points.ply", scale=1.5)
    found = open_capture(folder / "transforms.json")
    for a, b in zip(model.reconstruction.photos.values(), found.reconstruction.photos.values(), strict=True):
        np.testing.assert_allclose(a.camera_from_world, b.camera_from_world, atol=1e-9)
        assert a.lens == b.lens
    np.testing.assert_allclose(model.reconstruction.points, found.reconstruction.points)
    assert (model.reconstruction.colors == found.reconstruction.colors).all()
    assert [p.name for p in found.photos] == [f"images/{p.name}" for p in model.photos]


@pytest.mark.parametrize(
    ("top", "distortion", "fisheye"),
    [
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.01}, (0.01, 0, 0, 0), False),
        ({"camera_model": "RADIAL", "k1": 0.01, "k2": 0.02}, (0.01, 0.02, 0, 0), False),
        ({"camera_model": "opencv", "k1": 0.01, "p2": 0.03, "k3": 0.2}, (0.01, 0, 0, 0.03, 0.2), False),
        ({"camera_model": "PINHOLE"}, (), False),
        ({"camera_model": "FULL_OPENCV", "k6": 0.1}, (0, 0, 0, 0, 0, 0, 0, 0.1), False),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.1}, (0, 0, 0, 0.1), True),
        ({"is_fisheye": True, "k2": 0.1}, (0, 0.1, 0, 0), True),
        ({"distortion_params": [0.1, 0.2, 0.3, 0, 0.01, 0.02]}, (0.1, 0.2, 0.01, 0.02, 0.3), False),
    ],
)
def test_every_camera_model_has_its_coefficients(folder, top, distortion, fisheye):
    write_transforms(folder, **top)
    lens = open_capture(folder / "transforms.json").photos[0].lens
    assert (lens.distortion, lens.fisheye) == (distortion, fisheye)


def test_lists_of_photos_split_them(folder):
    names = [f"images/photo_{i:03d}.png" for i in range(6)]
    write_transforms(folder, train_filenames=names[:3], val_filenames=names[4:5], test_filenames=names[5:])
    assert open_capture(folder / "transforms.json").split == (tuple(names[:3]), tuple(names[4:]))


@pytest.mark.parametrize("missing", ["sparse_pc.ply", "points/a.ply"])
def test_points_that_are_not_there_are_told(folder, missing, capsys):
    write_transforms(folder, ply_file_path=missing)
    assert not len(open_capture(folder / "transforms.json").reconstruction.points)
    assert "random" in capsys.readouterr().out


# ── split and frame ─────────────────────────────────────────────────────────────────────────────────────


def random_poses(count, seed=0):
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, random_state=seed).as_matrix()
    return np.concatenate([turns, rng.normal(size=(count, 3, 1))], axis=2)


def ring(count=9):
    """Cameras around a place, which look at it, some from above (camera → world; y up, z backward)."""
    angles = np.arange(count) * 2 * np.pi / count
    places = np.column_stack([4 * np.cos(angles), 3 * np.sin(angles), 0.3 * np.arange(count)])
    back = places / np.linalg.norm(places, axis=1, keepdims=True)
    right = np.cross([0.1, 0, 1.0], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    tilted = Rotation.from_rotvec([0.4, 0.2, 0]).as_matrix()
    return tilted @ np.stack([right, np.cross(back, right), back, places + np.array([1.0, 2, 0])], axis=2)


@pytest.mark.nerfstudio
@pytest.mark.parametrize("orientation", ["up", "vertical", "none"])
@pytest.mark.parametrize("center", ["poses", "none"])
def test_the_frame_is_nerfstudios(orientation, center):
    import torch
    from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses

    poses = ring()
    whole = torch.from_numpy(np.concatenate([poses, np.tile([[[0, 0, 0, 1.0]]], (9, 1, 1))], axis=1)).float()
    theirs, _ = auto_orient_and_center_poses(whole, orientation, center)
    scale = 1 / float(theirs[:, :3, 3].abs().max())
    theirs[:, :3, 3] *= scale
    frame = find_frame(poses, np.zeros((0, 3)), np.eye(3), orientation, center)
    assert frame.scale == pytest.approx(scale, rel=1e-4)
    np.testing.assert_allclose(frame.poses(poses), theirs.numpy(), atol=1e-4)


def test_a_frame_on_a_map_is_exact_to_a_micrometer():
    poses, far = random_poses(9), np.array([4.5e5, 5.3e6, 120.0])
    moved = poses.copy()
    moved[:, :, 3] += far
    near, away = (find_frame(p, np.zeros((0, 3)), np.eye(3)) for p in (poses, moved))
    np.testing.assert_allclose(near.poses(poses), away.poses(moved), atol=1e-8)
    back = (away.points(moved[:, :, 3]) / away.scale - away.transform[:, 3]) @ away.transform[:, :3]
    np.testing.assert_allclose(back, moved[:, :, 3], atol=1e-6)


def test_a_frame_after_another_is_both():
    frame = Frame(random_poses(1)[0], 0.7)
    first, points = Frame(random_poses(1, 1)[0], 3.0), np.random.default_rng(2).normal(size=(5, 3))
    applied = 3.0 * (points @ first.transform[:, :3].T) + first.transform[:, 3]
    given = np.column_stack([first.transform[:, :3], first.transform[:, 3] / 3.0])
    np.testing.assert_allclose(frame.after(given, 3.0).points(points), frame.points(applied))


def test_the_inverse_of_a_frame_leads_back():
    frame, poses = Frame(random_poses(1)[0], 0.7), random_poses(5, 1)
    np.testing.assert_allclose(frame.inverse().poses(frame.poses(poses)), poses, atol=1e-12)


@pytest.mark.parametrize("times", [500, 20_000, 1e6])
@pytest.mark.parametrize("lost", [1, 2])
def test_lost_cameras_are_told_and_change_nothing(times, lost):
    poses = random_poses(10)
    centers = poses[:, :, 3].copy()
    centers[:lost] = [times, -times, 0]
    assert lost_cameras(centers, np.zeros((0, 3))).tolist() == [True] * lost + [False] * (10 - lost)


@pytest.mark.parametrize(
    ("times", "moved", "told"),
    [(1, 1, None), (0, 1, "in one place"), (1, 1e5, "in other units"), (1, 20, None)],
)
def test_cameras_and_points_of_no_scene_are_told(folder, capsys, times, moved, told):
    """Photos from one place, or points in other units than the cameras: both were trained without a word."""

    def line(text):
        name = text.split()
        if not text.endswith(".png"):
            return text
        turn = Rotation.from_quat(np.array(name[1:5], float)[[1, 2, 3, 0]])
        center = -turn.inv().apply(np.array(name[5:8], float))
        place = -turn.apply(moved * (times * center + (1 - times) * np.array([5.0, 0, 0])))
        return " ".join([*name[:5], *map(repr, place.tolist()), *name[8:]])

    as_text(folder, images=lambda lines: [line(one) for one in lines])
    open_capture(folder)
    said = capsys.readouterr().out
    assert (told in said) if told else "No scene comes of it" not in said


OPENGL = np.diag([1.0, -1, -1])


def inverted(view):
    return np.column_stack([view[:, :3].T, -view[:, :3].T @ view[:, 3]])


@pytest.mark.parametrize("tracked", [True, False])
def test_poses_that_look_away_from_the_points_are_told(folder, tracked):
    """As exporters write them that confuse the directions of poses, or OpenCV's axes with OpenGL's:
    they were trained on without a word."""
    model = read_reconstruction(folder / "sparse" / "0")
    for change, told in (
        (lambda view: view, False),
        (inverted, True),
        (lambda view: OPENGL @ view, True),
        (lambda view: inverted(OPENGL @ view), True),
        (lambda view: OPENGL @ inverted(OPENGL @ view), True),
    ):
        photos = [
            replace(
                photo, camera_from_world=change(photo.camera_from_world), points=photo.points[: tracked * 99]
            )
            for photo in model.photos.values()
        ]
        assert ("do not see the points" in str(wrong_cameras(photos, model.points))) == told
        few = [*photos[:2], *list(model.photos.values())[2:]]
        assert wrong_cameras(few, model.points) is None  # two photos may be of something else


@pytest.mark.parametrize(("times", "told"), [(1, False), (0.01, True), (0.25, True), (2, True)])
def test_lenses_of_pictures_of_another_size_are_told(folder, times, told, capsys):
    """As exporters write them that forget to scale the lens with the pictures."""
    lens = next(iter(read_reconstruction(folder / "sparse" / "0").photos.values())).lens
    values = {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    write_transforms(folder, **{key: value * times for key, value in values.items()})
    open_capture(folder / "transforms.json")
    assert ("pictures of another size" in capsys.readouterr().out) == told


@pytest.mark.parametrize("times", [1, 10, 50])
def test_far_cameras_are_not_lost(times):
    centers = random_poses(10)[:, :, 3]
    centers[0] *= times
    assert not lost_cameras(centers, np.zeros((0, 3))).any()
    still = np.zeros((10, 3))
    still[:4] = random_poses(4)[:, :, 3]
    assert not lost_cameras(still, np.zeros((0, 3))).any()


def test_a_capture_without_its_lost_photo_is_the_others_alone(folder, capsys):
    import pycolmap

    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    lost = next(image for image in model.images.values() if image.name == "photo_003.png")
    turn = lost.cam_from_world().rotation
    model.frames[lost.frame_id].rig_from_world = pycolmap.Rigid3d(turn, np.array([0, 0, 20_000.0]))
    model.write_binary(folder / "sparse" / "0")
    found = open_capture(folder)
    assert "pose is wrong" in found.left_out["photo_003.png"] and len(found.photos) == 5
    assert np.abs(found.poses(found.names)[:, :, 3]).max() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize(
    ("settings", "held_out"),
    [({}, [0]), ({"eval_interval": 2}, [0, 2, 4]), ({"eval_mode": "all"}, [0, 1, 2, 3, 4, 5])],
)
def test_the_split_follows_the_rule(folder, settings, held_out):
    split = open_capture(folder, CaptureSettings(**settings)).split
    assert split.held_out == tuple(f"photo_{i:03d}.png" for i in held_out)


@pytest.mark.parametrize("settings", [{"eval_interval": 0}, {"eval_interval": -2}, {"scale_factor": 0.0}])
def test_numbers_that_make_no_scene_are_refused(folder, settings):
    with pytest.raises(UserError, match="give a number from"):
        open_capture(folder, CaptureSettings(**settings))


def test_a_name_in_a_list_may_have_the_mark_of_comments(folder):
    for old, new in (("photo_001.png", "#1 front.png"), ("photo_002.png", "photo #2.png")):
        (folder / "images" / old).rename(folder / "images" / new)
    as_text(folder, lambda lines: [
        line.replace("photo_001", "#1 front").replace("photo_002", "photo #2") for line in lines
    ])  # fmt: skip
    (folder / "test_list.txt").write_text(
        "#1 front.png\nphoto #2.png\nphoto_003.png # blurred\n# photo_004.png\n"
    )
    assert open_capture(folder).split.held_out == ("#1 front.png", "photo #2.png", "photo_003.png")


def test_a_scene_has_its_folders_name_however_one_gets_there(folder, monkeypatch):
    monkeypatch.chdir(folder / "images")
    assert open_capture("..").folder.name == open_capture(folder).folder.name == folder.name


def test_lists_of_a_folder_split_its_photos(folder):
    (folder / "train_list.txt").write_text("photo_001.png\nphoto_002.png\n")
    (folder / "test_list.txt").write_text("photo_003.png\n")
    assert open_capture(folder).split == (("photo_001.png", "photo_002.png"), ("photo_003.png",))


def test_contradicted_photos_are_recorded_and_used_only_if_a_list_trains_on_them(folder, tmp_path):
    """The scene that training records has their cameras, and is split alike when it is opened again."""
    report = folder / "lang3dxl_cache" / REPORT
    report.parent.mkdir(parents=True)
    report.write_text(
        json.dumps(
            {
                "doubtful": {
                    "photo_000.png": CONTRADICTED,
                    "photo_003.png": CONTRADICTED,
                    "photo_004.png": LONELY,
                    "gone": LONELY,
                }
            }
        )
    )
    capture = open_capture(folder)
    train, held_out = capture.split
    assert held_out == ("photo_001.png",) and train == ("photo_002.png", "photo_004.png", "photo_005.png")
    data = TrainingData(capture, PreparationConfig(clip="none"), tmp_path, "cpu", targets_in_steps=False)
    record = data.record()
    assert {photo.name: photo.doubtful for photo in record.photos if photo.doubtful} == capture.doubtful
    assert sorted(photo.name for photo in record.photos) == capture.names
    assert recorded_capture(record).split == capture.split
    attached = photos_of(capture, np.eye(4), PreparationConfig(clip="none"), tmp_path, "cpu")
    assert sorted(attached.capture.split.train) == sorted((*train, *held_out))
    (folder / "train_list.txt").write_text("photo_002.png\nphoto_003.png\n")
    listed = open_capture(folder).split
    assert listed == (("photo_002.png", "photo_003.png"), ("photo_001.png", "photo_004.png", "photo_005.png"))
