"""New photos for a model: they find their places, and nothing of the model moves or is lost."""

import json
import os
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np  # before pycolmap
import pycolmap
import pytest
from PIL import Image
from scenes import CENTER, HALF_SIZES, speckled, write_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene import add_photos as module
from lang3dxl_ns.scene import matching, pairing
from lang3dxl_ns.scene.add_photos import add_photos
from lang3dxl_ns.scene.colmap import read_reconstruction
from lang3dxl_ns.scene.photo_folder import find_photos
from lang3dxl_ns.scene.placements import LEAST_MATCHES
from lang3dxl_ns.scene.reconstruct import reconstruct_scene
from lang3dxl_ns.scene.reconstruction import ReconstructionSettings, doubtful_photos

SIFT = ReconstructionSettings(features="sift")
LATE = ("photo_002.jpg", "photo_005.jpg")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A reconstruction of five photos of a speckled box, two further photos in late/, and the true model."""
    folder = tmp_path_factory.mktemp("made")
    write_scene(folder / "true", photos=7, size=(240, 180), paint=speckled)
    shutil.copytree(folder / "true" / "images", folder / "data" / "images")
    (folder / "late").mkdir()
    for name in LATE:
        shutil.move(folder / "data" / "images" / name, folder / "late" / name)
    reconstruct_scene(folder / "data", None, SIFT)
    return folder


@pytest.fixture
def scene(made, tmp_path):
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy"


def contents(model):
    """What must not change, by number: cameras, poses and points."""
    model = pycolmap.Reconstruction(model)
    images = {i: (m.name, m.cam_from_world().matrix().tobytes()) for i, m in model.images.items()}
    cameras = {i: (camera.model_name, camera.params.tobytes()) for i, camera in model.cameras.items()}
    points = {i: (point.xyz.tobytes(), point.color.tobytes()) for i, point in model.points3D.items()}
    return images, cameras, points


def places(model, true):
    """Places of all cameras in the model, and the true ones."""
    found, known = read_reconstruction(model).photos, read_reconstruction(true).photos
    true_names = [name.rsplit("/", 1)[-1] for name in found]
    return np.array([p.center for p in found.values()]), np.array([known[n].center for n in true_names])


def alignment(model, true):
    """The similarity from the model's frame to the true one."""
    return pycolmap.estimate_sim3d(*places(model, true))


def errors(model, true):
    """Distances of all cameras from the true ones once aligned, by name."""
    stand, belong = places(model, true)
    apart = np.linalg.norm(alignment(model, true) * stand - belong, axis=1)
    return dict(zip(read_reconstruction(model).photos, apart, strict=True))


def test_new_photos_find_their_places_and_nothing_else_moves(scene, capsys):
    before = contents(scene / "data/sparse/0")
    model = add_photos(scene / "data", scene / "late", None, SIFT)
    assert model == scene / "data" / "sparse" / "0"
    after = contents(model)
    for old, new in zip(before, after, strict=True):
        assert old.items() <= new.items()
    assert len(after[0]) == 7
    distances = errors(model, scene / "true/sparse/0")
    assert max(distances[f"late/{name}"] for name in LATE) < 0.15  # of about 4 to the box
    photos = read_reconstruction(model).photos
    assert all(len(photos[f"late/{name}"].points) >= 30 for name in LATE)  # depth for crops in physical scale
    assert {f"late/{name}" for name in LATE} <= set(find_photos(scene / "data").names)
    assert "2 of 2 new photos have a pose" in capsys.readouterr().out


def test_what_new_photos_alone_show_becomes_points(scene):
    """They lie on the box, as the model's points do, and have colors."""
    before = pycolmap.Reconstruction(scene / "data/sparse/0")
    after = pycolmap.Reconstruction(add_photos(scene / "data", scene / "late", None, SIFT))
    late = {number for number, image in after.images.items() if image.name.startswith("late/")}
    new = [point for number, point in after.points3D.items() if number not in before.points3D]
    assert len(new) > 20
    assert all({e.image_id for e in point.track.elements} == late for point in new)
    assert len({point.color.tobytes() for point in new}) > 5
    there = alignment(scene / "data/sparse/0", scene / "true/sparse/0") * np.array([p.xyz for p in new])
    outside = np.abs((there - CENTER) / HALF_SIZES).max(axis=1)
    assert np.abs(outside - 1).max() < 0.2


def late_cameras(model):
    model = pycolmap.Reconstruction(model)
    late = [image for image in model.images.values() if image.name.startswith("late/")]
    return [model.cameras[image.camera_id].params for image in late], model.cameras[1].params


def test_a_photo_of_the_size_that_one_camera_of_the_model_takes_has_its_lens(scene):
    params, old = late_cameras(add_photos(scene / "data", scene / "late", None, SIFT))
    assert all((found == old).all() for found in params)


def test_a_photo_of_another_size_finds_its_own_lens(scene):
    for name in LATE:
        with Image.open(scene / "late" / name) as image:
            image.resize((320, 240), Image.Resampling.LANCZOS).save(scene / "late" / name, quality=97)
    model = add_photos(scene / "data", scene / "late", None, SIFT)
    params, old = late_cameras(model)
    assert all(abs(found[0] / old[0] - 320 / 240) < 0.15 for found in params)
    distances = errors(model, scene / "true/sparse/0")
    assert max(distances[f"late/{name}"] for name in LATE) < 0.3  # of about 4 to the box


@pytest.mark.parametrize("earlier", ["its own", "another model's", None])
def test_the_report_and_the_picture_know_the_new_photos(scene, monkeypatch, earlier):
    """Of photos that were doubtful before, only the model's own stay: other scenes have the same names."""
    work, place = scene / "data/lang3dxl_cache/reconstruction", scene / "data/sparse/0"
    before, told = (work / "cameras.png").read_bytes(), json.loads((work / "report.json").read_text())
    told["doubtful"] = {"photo_000.jpg": "it looks up"}
    if earlier == "another model's":
        told["model"] = told["model"][::-1]  # which a new reconstruction names
    (work / "report.json").write_text(json.dumps(told))
    if earlier is None:
        (work / "report.json").unlink()
    known = told["doubtful"] if earlier == "its own" else {}
    assert doubtful_photos(work.parent, place) == known
    monkeypatch.setattr(module, "doubtful_placements", lambda *_: dict.fromkeys(range(1, 8), "it looks away"))
    add_photos(scene / "data", scene / "late", None, SIFT)
    added = {f"late/{name}": "it looks away" for name in LATE}
    assert doubtful_photos(work.parent, place) == known | added
    assert (work / "cameras.png").read_bytes() != before


def test_the_report_counts_each_photo_once_however_often_it_is_added(scene):
    report = scene / "data/lang3dxl_cache/reconstruction/report.json"
    noise = np.random.default_rng(0).integers(0, 255, (180, 240, 3), np.uint8)
    Image.fromarray(noise).save(scene / "late" / "noise.jpg")
    shutil.move(scene / "late" / LATE[1], scene / LATE[1])
    for number in (6, 7):
        model = pycolmap.Reconstruction(add_photos(scene / "data", scene / "late", None, SIFT))
        told = json.loads(report.read_text())
        assert told["registered"] == number
        assert told["points"] == model.num_points3D()
        assert set(told["left_out"]) == {"late/noise.jpg"}
        assert told["photos"] == number + 1
        shutil.copy(scene / LATE[1], scene / "late")


@pytest.fixture
def extracted(monkeypatch):
    """Numbers of the photos whose features are extracted."""
    numbers, extract = [], pycolmap.extract_features

    def noted(database, folder, names, **options):
        numbers.extend(int(name[:6]) for name in names)
        extract(database, folder, names, **options)

    monkeypatch.setattr(pycolmap, "extract_features", noted)
    return numbers


def found(data):
    """Features and matches in the database of added photos, to the byte, by table."""
    tables = {}
    database = data / "lang3dxl_cache/reconstruction/adding/database.db"
    with closing(sqlite3.connect(database)) as db:
        for table in ("keypoints", "descriptors", "matches"):
            tables[table] = sorted(db.execute(f"SELECT * FROM {table}"))
    return tables


def test_features_of_the_first_reconstruction_are_kept_and_change_nothing(
    scene, extracted, capsys, monkeypatch
):
    """One thread matches: of several, COLMAP's has once left the first photo's pairs without any match. It
    verifies matches with random numbers of its own, so new poses differ a little anyway."""
    monkeypatch.setattr(matching, "_threads", lambda _: 1)
    shutil.copytree(scene, scene / "anew")
    shutil.rmtree(scene / "anew/data/lang3dxl_cache")
    before = contents(scene / "data/sparse/0")
    with_kept = add_photos(scene / "data", scene / "late", None, SIFT)
    assert extracted == [5, 6]
    assert "features of 5 of 7 photos are kept" in capsys.readouterr().out
    extracted.clear()
    without = add_photos(scene / "anew/data", scene / "anew/late", None, SIFT)
    assert extracted == [0, 1, 2, 3, 4, 5, 6]
    assert found(scene / "data") == found(scene / "anew/data")
    photos, same = read_reconstruction(with_kept).photos, read_reconstruction(without).photos
    assert photos.keys() == same.keys() and len(photos) == 7
    for name, photo in photos.items():
        np.testing.assert_allclose(photo.center, same[name].center, atol=0.02)
    for model in map(contents, (with_kept, without)):
        assert all(old.items() <= new.items() for old, new in zip(before, model, strict=True))
    assert "features of 0 of 7 photos are kept" in capsys.readouterr().out


def test_features_of_a_photo_that_was_changed_are_extracted_anew(scene, extracted):
    changed = scene / "data/images/photo_001.jpg"
    content, time = bytearray(changed.read_bytes()), changed.stat().st_mtime_ns
    content[15] ^= 1  # its resolution, in dots per inch
    changed.write_bytes(content)
    os.utime(changed, ns=(time, time))
    add_photos(scene / "data", scene / "late", None, SIFT)
    assert extracted == [1, 5, 6]


def test_features_by_other_settings_are_not_taken(scene, extracted):
    add_photos(scene / "data", scene / "late", None, replace(SIFT, max_features=3000))
    assert extracted == [0, 1, 2, 3, 4, 5, 6]


def test_photos_that_were_added_keep_their_features_for_the_next(scene, extracted):
    shutil.move(scene / "late" / LATE[1], scene / LATE[1])
    add_photos(scene / "data", scene / "late", None, SIFT)
    shutil.move(scene / LATE[1], scene / "late")
    extracted.clear()
    add_photos(scene / "data", scene / "late", None, ReconstructionSettings())
    assert extracted == [6]


@pytest.mark.parametrize(
    "lie",
    [
        None,
        "drop table matches",
        "update descriptors set rows = 1000000000",
        "update keypoints set cols = 3, rows = 2 * rows",
    ],
)
def test_a_damaged_database_of_features_is_as_good_as_none(scene, extracted, lie):
    """Of sizes that lie, COLMAP's library would read as many bytes."""
    work = scene / "data/lang3dxl_cache/reconstruction"
    if lie is None:
        for path in work.glob("database.db*"):
            path.unlink()
        (work / "database.db").write_bytes(b"no database" * 1000)
    else:
        with closing(sqlite3.connect(work / "database.db")) as db, db:
            db.execute(lie)
    add_photos(scene / "data", scene / "late", None, SIFT)
    assert extracted == [0, 1, 2, 3, 4, 5, 6]


def test_photos_that_share_points_are_pairs(made):
    """As counted pair by pair; of large collections, they tell which photos a new one's partners match."""
    model = pycolmap.Reconstruction(made / "data/sparse/0")
    shown = {
        image.name: {point.point3D_id for point in image.points2D if point.has_point3D()}
        for image in model.images.values()
    }
    names = sorted(shown)
    shared = {(a, b): len(shown[a] & shown[b]) for a in names for b in names if a < b}
    assert module._pairs_of(model) == {pair for pair, count in shared.items() if count >= LEAST_MATCHES}
    assert len(module._pairs_of(model)) > 4


def test_in_large_collections_new_photos_are_tried_with_their_partners_partners(scene, monkeypatch):
    monkeypatch.setattr(pairing, "EXHAUSTIVE", 0)
    monkeypatch.setattr(pairing, "ALIKE", 1)
    tried, matched = set(), pycolmap.match_image_pairs

    def noted(database, options, pairs):
        tried.update(pairs.match_list_path.read_text().splitlines())
        matched(database, options, pairs)

    monkeypatch.setattr(pycolmap, "match_image_pairs", noted)
    add_photos(scene / "data", scene / "late", None, SIFT)
    assert len(tried) == 2 * 5 + 1  # of these, looks and names alone give 8


def test_frames_of_a_video_are_added(scene, monkeypatch):
    (scene / "walk.mp4").write_bytes(b"")
    monkeypatch.setattr(module, "extract_frames", lambda video: scene / "late")
    assert len(contents(add_photos(scene / "data", scene / "walk.mp4", None, SIFT))[0]) == 7


def test_a_mapper_has_nothing_to_do(scene):
    with pytest.raises(UserError, match="leave out --mapper"):
        add_photos(scene / "data", scene / "late", None, replace(SIFT, mapper="global"))


@pytest.mark.parametrize("place", ["sparse/0", "."])
def test_the_model_as_it_was_is_kept_and_what_else_is_in_its_folder_stays(scene, place):
    """The folder may be the photos'. A text beside the binary files would be the model that was."""
    data = scene / "data"
    place = data / place
    pycolmap.Reconstruction(data / "sparse/0").write_text(data / "sparse/0")
    files = {path.name: path.read_bytes() for path in (data / "sparse/0").iterdir()}
    if place == data:
        for name in files:
            shutil.move(data / "sparse/0" / name, data / name)
        shutil.rmtree(data / "sparse")
    (place / "notes").mkdir()
    others = [path for path in (place, *place.iterdir(), *data.glob("images/*")) if path.name not in files]
    inodes = [path.stat().st_ino for path in others]
    assert add_photos(data, scene / "late", None, SIFT) == place
    assert [path.stat().st_ino for path in others] == inodes
    assert {path.name for path in place.iterdir() if path.is_file()} == {
        n for n in files if n.endswith("bin")
    }
    kept = data / "lang3dxl_cache/reconstruction/before_adding_1"
    assert {path.name: path.read_bytes() for path in kept.iterdir()} == files
    with pytest.raises(UserError, match="holds no photos that the model lacks"):
        add_photos(scene / "data", scene / "late", None, SIFT)


def test_a_model_that_a_full_disk_cuts_off_replaces_nothing(scene, monkeypatch):
    """COLMAP writes on and is silent."""
    write, place = pycolmap.Reconstruction.write_binary, scene / "data/sparse/0"

    def cut_off(model, folder):
        write(model, folder)
        os.truncate(folder / "images.bin", 500)

    files = {path.name: path.read_bytes() for path in place.iterdir()}
    monkeypatch.setattr(pycolmap.Reconstruction, "write_binary", cut_off)
    with pytest.raises(UserError, match=r"can't be written to .*sparse/0 .*: make room"):
        add_photos(scene / "data", scene / "late", None, SIFT)
    assert {path.name: path.read_bytes() for path in place.iterdir()} == files


def test_a_copy_that_was_interrupted_leaves_nothing(scene, monkeypatch):
    """Else it would be taken for another photo of that name."""
    copy, photo = scene / "late/copies/a.jpg", scene / "late" / LATE[0]
    monkeypatch.setattr(os, "fsync", lambda _: os.write(-1, b""))
    with pytest.raises(OSError, match="Bad file descriptor"):
        module._copied(photo, copy)
    assert not list((scene / "late/copies").iterdir())
    monkeypatch.undo()
    module._copied(photo, copy)
    assert copy.read_bytes() == photo.read_bytes() and copy.stat().st_mtime_ns == photo.stat().st_mtime_ns


@pytest.mark.parametrize("linked", [None, "data", "data/images"])
def test_new_photos_are_copied_wherever_links_and_relative_paths_lead(scene, monkeypatch, linked):
    data, late = Path("data"), Path("late")
    monkeypatch.chdir(scene)
    if linked:
        (scene / "far/away").mkdir(parents=True)
        shutil.move(linked, scene / "far/away/moved")
        Path(linked).symlink_to(scene / "far/away/moved")
    else:  # photos in the scene's folder itself
        for photo in Path("data/images").iterdir():
            shutil.move(photo, "data")
        Path("data/images").rmdir()
        monkeypatch.chdir("data")
        data, late = Path(), Path("../late")
    photos = read_reconstruction(add_photos(data, late, None, SIFT)).photos
    added = {f"late/{name}" for name in LATE}
    assert len(photos) == 7 and added < set(photos)
    assert added < set(find_photos(scene / "data").names)


def test_a_model_behind_a_link_out_of_the_scene_is_not_replaced(scene):
    shutil.move(scene / "data/sparse", scene / "other")
    (scene / "data/sparse").symlink_to(scene / "other")
    with pytest.raises(UserError, match="leads out of"):
        add_photos(scene / "data", scene / "late", None, SIFT)


def test_photos_without_a_place_are_named_and_not_copied(scene, capsys):
    noise = np.random.default_rng(0).integers(0, 255, (180, 240, 3), np.uint8)
    Image.fromarray(noise).save(scene / "late" / "noise.jpg")
    shutil.copy(scene / "data/images/photo_000.jpg", scene / "late" / "twin.jpg")
    model = add_photos(scene / "data", scene / "late", None, SIFT)
    told = capsys.readouterr().out
    assert "2 of 4 new photos" in told
    assert "too few of its matches agree: late/noise.jpg" in told
    assert "the same file as photo_000.jpg: late/twin.jpg" in told
    assert len(read_reconstruction(model).photos) == 7
    assert sorted(path.name for path in (scene / "data/images/late").iterdir()) == list(LATE)


def test_where_no_photo_finds_a_place_the_model_stays(scene):
    before = (scene / "data/sparse/0/images.bin").read_bytes()
    noise = np.random.default_rng(0).integers(0, 255, (180, 240, 3), np.uint8)
    (scene / "other").mkdir()
    Image.fromarray(noise).save(scene / "other" / "noise.jpg")
    with pytest.raises(UserError, match=r"none of the 1 new photos can be placed.*other/noise\.jpg"):
        add_photos(scene / "data", scene / "other", None, SIFT)
    assert (scene / "data/sparse/0/images.bin").read_bytes() == before
    assert not (scene / "data/images/other").exists()


def test_another_photo_of_that_name_is_never_overwritten(scene):
    taken = scene / "data/images/late"
    taken.mkdir()
    (taken / LATE[0]).write_bytes(b"mine")
    with pytest.raises(UserError, match="is another photo: rename the folder"):
        add_photos(scene / "data", scene / "late", None, SIFT)
    assert (taken / LATE[0]).read_bytes() == b"mine"


def test_a_model_as_text_of_unknown_features_and_photos_that_lie_among_its_own(scene):
    data = scene / "data"
    model = pycolmap.Reconstruction(data / "sparse/0")
    shutil.rmtree(data / "sparse/0")
    shutil.rmtree(data / "lang3dxl_cache")
    (data / "sparse/0").mkdir()
    model.write_text(data / "sparse/0")
    for name in LATE:
        shutil.move(scene / "late" / name, data / "images" / name)
    place = add_photos(data, data / "images", None, SIFT)
    assert (place / "images.txt").is_file() and not (place / "images.bin").exists()
    distances = errors(place, scene / "true/sparse/0")
    assert len(distances) == 7 and max(distances.values()) < 0.15


@pytest.mark.parametrize(
    ("part", "kept"),
    [
        ("points3D", lambda line: " ".join(line.split()[:4])),
        ("images", lambda line: line * line.endswith("jpg")),
    ],
    ids=["no colors", "no keypoints"],
)
def test_a_text_model_that_lacks_what_new_photos_need_is_refused_before_the_work(
    scene, extracted, part, kept
):
    place = scene / "data/sparse/0"
    pycolmap.Reconstruction(place).write_text(place)
    for path in (*place.glob("*.bin"), place / "rigs.txt", place / "frames.txt"):
        path.unlink()
    lines = [line for line in (place / f"{part}.txt").read_text().splitlines() if line[0] != "#"]
    (place / f"{part}.txt").write_text("".join(f"{kept(line)}\n" for line in lines))
    assert len(read_reconstruction(place).photos) == 5
    with pytest.raises(UserError, match=r"sparse/0 can't be added to .*: export it in binary form"):
        add_photos(scene / "data", scene / "late", None, SIFT)
    assert extracted == []


def test_a_photo_of_the_model_in_which_nothing_is_found_has_no_part(scene, monkeypatch):
    monkeypatch.setattr(pairing, "EXHAUSTIVE", 0)
    Image.new("RGB", (240, 180), "gray").save(scene / "data/images/photo_000.jpg")
    assert len(contents(add_photos(scene / "data", scene / "late", None, SIFT))[0]) > 5


def test_a_stopped_addition_goes_on_with_what_it_has(scene, monkeypatch):
    def stopped(*arguments):
        raise KeyboardInterrupt

    match = module.match
    monkeypatch.setattr(module, "match", stopped)
    with pytest.raises(KeyboardInterrupt):
        add_photos(scene / "data", scene / "late", None, SIFT)
    monkeypatch.setattr(module, "match", match)
    assert len(read_reconstruction(scene / "data/sparse/0").photos) == 5

    def again(*arguments, **options):
        raise AssertionError("features are extracted twice")

    monkeypatch.setattr(pycolmap, "extract_features", again)
    assert len(read_reconstruction(add_photos(scene / "data", scene / "late", None, SIFT)).photos) == 7


def test_without_a_model_the_way_to_one_is_told(scene):
    shutil.rmtree(scene / "data/sparse")
    with pytest.raises(UserError, match="reconstruct its own photos first"):
        add_photos(scene / "data", scene / "late", None, SIFT)


def test_new_photos_are_not_copied_through_a_link_that_came_with_the_scene(tmp_path):
    """Who made the scene's folder would choose where they go."""
    for name in ("scene", "late", "elsewhere"):
        (tmp_path / name).mkdir()
    Image.new("RGB", (8, 6)).save(tmp_path / "late" / "a.jpg")
    (tmp_path / "scene" / "late").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="leads out of"):
        module._targets(tmp_path / "late", tmp_path / "scene", set())
