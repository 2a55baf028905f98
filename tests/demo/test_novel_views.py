"""Test views: novel cameras with the generator's labels, and enough of every category."""

import json

import numpy as np
import pytest
from PIL import Image

from lab.landmark.labels import PART, SMALLEST_POSITIVE, category_masks
from lab.landmark.landmark import FAMILIES, Landmark
from lab.landmark.novel_cameras import EACH, choose_cameras
from lab.landmark.novel_views import read_novel_views
from lab.landmark.photography import plain_view, take_photo
from lab.landmark.raycast import Camera
from lab.landmark.scene_writer import TEST_POINTS, DemoScene, write_scene
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.colmap import read_reconstruction

SIZE, SEED, VIEWS = (120, 90), 6, 15


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    settings = DemoScene(
        tmp_path_factory.mktemp("novel") / "scene", seed=SEED, family="mosque", photos=6, test_views=VIEWS
    )
    settings.width, settings.height, settings.workers = *SIZE, 1
    return write_scene(settings)


@pytest.fixture(scope="module")
def views(scene):
    return read_novel_views(scene)


def cast_again(scene, geometry):
    """What the generator renders for the camera in cameras.json."""
    frame = json.loads((scene / "scene.json").read_text())["colmap_from_meters"]
    turned, scale, shift = np.array(frame["rotation"]), frame["scale"], np.array(frame["translation"])
    position = turned.T @ (geometry.center - shift) / scale
    camera = Camera(position, geometry.camera_from_world[:, :3] @ turned, geometry.lens.fx / max(SIZE))
    return take_photo(Landmark.from_seed(SEED, "mosque"), plain_view(camera), *SIZE)


def test_labels_are_what_the_generator_casts_from_the_written_camera(scene, views):
    for geometry in views.cameras:
        shot = cast_again(scene, geometry)
        assert not np.isin(shot.parts, [PART["person"], PART["car"]]).any()
        picture = np.asarray(Image.open(views.image(geometry))).astype(float)
        assert np.abs(picture - shot.image).mean() < 15  # JPEG, and fewer rays per pixel
        for category, mask in category_masks(shot.parts, shot.elements).items():
            path = views.folder / "ground_truth" / category / f"{views.image(geometry).stem}.png"
            assert path.exists() == (mask.mean() >= SMALLEST_POSITIVE)
            if path.exists():
                assert (np.asarray(Image.open(path).convert("L")) // 255 != mask).mean() < 1e-3


def test_points_of_a_view_lie_on_what_it_sees(scene, views):
    scale = json.loads((scene / "scene.json").read_text())["colmap_from_meters"]["scale"]
    for geometry in views.cameras:
        x, _, z = geometry.camera_from_world @ np.column_stack([geometry.points, np.ones(TEST_POINTS)]).T
        column, row = geometry.pixels.astype(int).T
        np.testing.assert_allclose(geometry.lens.fx * x / z + geometry.lens.cx, geometry.pixels[:, 0])
        assert np.median(np.abs(cast_again(scene, geometry).depth[row, column] * scale / z - 1)) < 0.01


def test_test_cameras_took_no_photo(scene, views):
    photos = read_reconstruction(scene / "sparse" / "0").photos.values()
    assert not any(name.startswith("test_views") for name in (photo.name for photo in photos))
    scale = json.loads((scene / "scene.json").read_text())["colmap_from_meters"]["scale"]
    for geometry in views.cameras:
        nearest = min(np.linalg.norm(photo.center - geometry.center) for photo in photos)
        assert nearest / scale > 0.05  # meters


@pytest.mark.parametrize("family", FAMILIES)
def test_every_category_is_in_five_views(family):
    landmark = Landmark.from_seed(11, family)
    cameras = choose_cameras(landmark, VIEWS, True, SIZE)
    counts = dict.fromkeys(category_masks(np.zeros(1, int), np.zeros(1, int)), 0)
    for camera in cameras:
        shot = take_photo(landmark, plain_view(camera), *SIZE)
        for category, mask in category_masks(shot.parts, shot.elements).items():
            counts[category] += mask.mean() >= SMALLEST_POSITIVE
    parts = {shape.part for shape in landmark.shapes}
    present = {"windows", "portals"} | {
        name for name in counts if name[:-1] in PART and PART[name[:-1]] in parts
    }
    assert len(cameras) == VIEWS and len(present) >= 3
    assert {name for name, count in counts.items() if count >= EACH} == present


def test_cameras_are_the_same_at_every_call_and_of_their_seed():
    first, again, other = (
        choose_cameras(Landmark.from_seed(seed, "hall"), 4, True, SIZE) for seed in (3, 3, 4)
    )
    positions = [np.array([camera.position for camera in cameras]) for cameras in (first, again, other)]
    np.testing.assert_array_equal(positions[0], positions[1])
    assert (positions[0] != positions[2]).any()


def test_a_damaged_file_of_cameras_is_named(tmp_path):
    assert read_novel_views(tmp_path) is None
    (tmp_path / "test_views").mkdir()
    (tmp_path / "test_views" / "cameras.json").write_text('{"views": [{}]}')
    with pytest.raises(UserError, match=r"cameras\.json is damaged .*make the scene again"):
        read_novel_views(tmp_path)
