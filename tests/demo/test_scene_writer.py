"""The demo scene's folder: what COLMAP, a trainer and a scorer read back matches what was rendered."""

import json
from functools import cache

import numpy as np
import pytest
from PIL import Image

from lab.landmark.labels import PART, SMALLEST_POSITIVE, building_mask, category_masks
from lab.landmark.landmark import Landmark
from lab.landmark.photography import take_photo
from lab.landmark.scene_writer import DemoScene, photo_view, write_scene
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.colmap import read_reconstruction

PHOTOS, SIZE, SEED = 12, (120, 90), 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write(tmp_path_factory.mktemp("demo") / "scene", workers=2)


def write(out, **changes):
    settings = {"seed": SEED, "family": "mosque", "photos": PHOTOS, "test_views": 6, "workers": 1}
    size = {"width": SIZE[0], "height": SIZE[1]}
    return write_scene(DemoScene(out=out, **(settings | size | changes)))


@cache
def shot(number):
    """Photo `number`, rendered again."""
    landmark = Landmark.from_seed(SEED, "mosque")
    view, width, height = photo_view(landmark, SEED, number, True, SIZE)
    return take_photo(landmark, view, width, height)


def test_same_seed_gives_the_same_bytes_for_any_number_of_workers(folder, tmp_path):
    again = write(tmp_path / "again", workers=1)
    files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    for path in files:
        assert (folder / path).read_bytes() == (again / path).read_bytes(), path


def test_points_reproject_within_the_noise(folder):
    errors = np.concatenate(
        [np.linalg.norm(projected(photo)[0] - photo.pixels, axis=1) for photo in photos(folder).values()]
    )
    assert len(errors) > 500
    assert 0.3 < np.median(errors) < 1.0  # a deviation of 0.3–0.7 px on either axis
    assert np.quantile(errors, 0.98) < 2.5


def photos(folder):
    return read_reconstruction(folder / "sparse" / "0").photos


def projected(photo):
    """Pixels and depths (COLMAP units) of the points that a photo has tracked."""
    x, y, z = photo.camera_from_world @ np.column_stack([photo.points, np.ones(len(photo.points))]).T
    return np.column_stack([photo.lens.fx * x / z + photo.lens.cx, photo.lens.fy * y / z + photo.lens.cy]), z


def test_tracks_respect_visibility(folder):
    """A photo's surface at a keypoint is at the point's depth, and not a passer-by."""
    scale = json.loads((folder / "scene.json").read_text())["colmap_from_meters"]["scale"]
    agree, passing = [], []
    for name, photo in photos(folder).items():
        truth = shot(int(name[:4]))
        column, row = projected(photo)[0].astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < photo.width) & (row < photo.height)
        shown = truth.depth[row[inside], column[inside]]
        agree.append(np.abs(shown * scale / projected(photo)[1][inside] - 1) < 0.03)
        passing.append(np.isin(truth.parts[row[inside], column[inside]], [PART["person"], PART["car"]]))
    assert np.concatenate(agree).mean() > 0.95
    assert np.concatenate(passing).mean() < 0.01


def test_some_points_are_wrong(folder):
    """False matches are tracked in two photos, true points in three or more, and most lie off the surface."""
    scale = json.loads((folder / "scene.json").read_text())["colmap_from_meters"]["scale"]
    wrong = {}
    for name, photo in photos(folder).items():
        pixels, z = projected(photo)
        column, row = np.clip(pixels.astype(int), 0, [photo.width - 1, photo.height - 1]).T
        off = np.abs(shot(int(name[:4])).depth[row, column] * scale / z - 1) > 0.05
        for point, is_off in zip(photo.points, off, strict=True):
            wrong.setdefault(tuple(point), []).append(is_off)
    false = [observations for observations in wrong.values() if len(observations) == 2]
    assert 0.003 < len(false) / len(wrong) < 0.04
    assert np.mean([any(observations) for observations in false]) > 0.3


def test_points_keep_their_label_in_every_photo(folder):
    labels = {}
    for name, photo in photos(folder).items():
        pixels = projected(photo)[0].astype(int)
        truth = shot(int(name[:4]))
        for point, (column, row) in zip(photo.points, pixels, strict=True):
            if 0 <= column < photo.width and 0 <= row < photo.height:
                labels.setdefault(tuple(point), []).append(truth.parts[row, column])
    same = [np.mean(np.array(parts) == np.bincount(parts).argmax()) for parts in labels.values()]
    assert np.mean(same) > 0.95


def test_masks_are_the_building(folder):
    for number in range(1, PHOTOS + 1):
        mask = np.asarray(Image.open(folder / "masks" / f"{number:04d}.png").convert("L")) >= 128
        np.testing.assert_array_equal(mask, building_mask(shot(number).parts))


def test_photos_match_their_cameras_and_labels(folder):
    for name, photo in photos(folder).items():
        image = Image.open(folder / "images" / name)
        assert image.size == (photo.width, photo.height)
        again = shot(int(name[:4])).image.astype(float)
        assert np.abs(np.asarray(image) - again).mean() < 15  # JPEG, and fewer rays per pixel


def test_ground_truth_is_the_categories(folder):
    files = 0
    for number in range(1, PHOTOS + 1):
        masks = category_masks(shot(number).parts, shot(number).elements)
        for category, mask in masks.items():
            truth = folder / "ground_truth" / category / f"{number:04d}-gt.jpg"
            expected = (number - 1) % 2 == 0 and mask.mean() >= SMALLEST_POSITIVE
            assert truth.exists() == expected, truth
            if not expected:
                continue
            read = 1 - np.asarray(Image.open(truth).convert("L")) / 255 > 0.5
            assert (read != mask).mean() < 1e-3
            copy = truth.with_name(f"{number:04d}-img.jpg")
            assert copy.read_bytes() == (folder / "images" / f"{number:04d}.jpg").read_bytes()
            files += 1
    assert files > 10


def test_held_out_names_are_those_of_the_interval_split(folder):
    split = pytest.importorskip("nerfstudio.data.utils.dataparsers_utils").get_train_eval_split_interval
    names = sorted(path.name for path in (folder / "images").iterdir())
    _, held_out = split(names, 8)
    description = json.loads((folder / "scene.json").read_text())
    assert description["held_out"] == [names[i] for i in held_out]
    truth = {path.name[:4] for path in (folder / "ground_truth").rglob("*-gt.jpg")}
    assert all(name[:4] in truth for name in description["held_out"])


def test_calm_photos_share_one_camera_and_exposure(tmp_path):
    folder = write(tmp_path / "calm", photos=4, wild=False)
    cameras = {(p.width, p.height, p.lens.fx) for p in photos(folder).values()}
    assert len(cameras) == 1
    assert next(iter(cameras))[:2] == SIZE
    # The sky's top rows are the same sky under the same exposure.
    landmark = Landmark.from_seed(SEED, "mosque")
    views = [photo_view(landmark, SEED, number, False, SIZE)[0] for number in range(1, 5)]
    assert {(view.lens, view.weather) for view in views} == {(views[0].lens, views[0].weather)}


def test_world_frame_is_arbitrary(folder):
    similarity = json.loads((folder / "scene.json").read_text())["colmap_from_meters"]
    rotation = np.array(similarity["rotation"])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert abs(rotation[2, 2]) < 0.999
    assert similarity["scale"] != 1


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match=r"isn't an empty folder: give --out another name"):
        write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"photos": 1}, "4 to 9999"), ({"seed": -1}, "0 or more"), ({"width": 10}, "64 pixels or more")],
)
def test_impossible_numbers_are_refused(tmp_path, changes, words):
    with pytest.raises(UserError, match=words):
        write(tmp_path / "scene", **changes)
    assert not list(tmp_path.iterdir())
