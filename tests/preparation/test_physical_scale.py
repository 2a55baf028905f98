import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import write_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.physical_scale import (
    crop_sides,
    physical_scales,
    pixel_size,
    pixel_sizes,
    propose_scale_range,
    relative_scales,
)
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto, read_reconstruction


def make_photo(
    points=((0.0, 0.0, 10.0),), pixels=None, width=1000, height=1000, focal=1000.0, name="a.jpg"
) -> TrackedPhoto:
    """A camera at the origin that looks along z."""
    points = np.array(points, dtype=float).reshape(-1, 3)
    if pixels is None:
        pixels = np.tile([width / 2, height / 2], (len(points), 1))
    pose = np.eye(3, 4)
    lens = Lens(width, height, focal, focal, width / 2, height / 2)
    return TrackedPhoto(name, lens, pose, points, np.array(pixels))


def make_reconstruction(*photos, points=()) -> Reconstruction:
    points = np.array(points, dtype=float).reshape(-1, 3)
    return Reconstruction(
        {photo.name: photo for photo in photos}, points, np.zeros((len(points), 3), np.uint8)
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("box") / "scene", size=(240, 180))


@pytest.fixture(scope="module")
def mixed_scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("mixed") / "scene", mixed=True)


# The published scale ranges of the six HolyScenes buildings.
@pytest.mark.parametrize(
    ("smallest", "largest", "scales"),
    [
        (0.4, 2.0, [0.400, 0.598, 0.894, 1.338, 2.000]),
        (0.5, 3.0, [0.500, 0.783, 1.225, 1.917, 3.000]),
        (0.2, 0.9, [0.200, 0.330, 0.545, 0.900]),
        (0.3, 2.0, [0.300, 0.482, 0.775, 1.245, 2.000]),
        (0.05, 0.8, [0.050, 0.074, 0.110, 0.164, 0.244, 0.362, 0.538, 0.800]),
        (0.2, 3.0, [0.200, 0.294, 0.434, 0.638, 0.940, 1.384, 2.038, 3.000]),
    ],
)
def test_published_scale_lists_are_reproduced(smallest, largest, scales):
    assert physical_scales(smallest, largest) == pytest.approx(scales, abs=6e-4)


def test_a_narrow_range_has_one_scale_and_an_empty_one_is_refused():
    assert physical_scales(0.7, 0.7) == [0.7]
    for smallest, largest in ((2.0, 1.0), (0.0, 1.0), (1.0, float("inf")), (float("nan"), 1.0)):
        with pytest.raises(UserError, match="scale range"):
            physical_scales(smallest, largest)


def test_relative_scales_are_seven_from_a_twentieth_to_half():
    scales = relative_scales()
    assert len(scales) == 7 and (scales[0], scales[-1]) == pytest.approx((0.05, 0.5))
    assert np.ptp(np.diff(np.log(scales))) < 1e-9


@pytest.mark.parametrize(
    ("ratio", "paper", "half"),
    zip(
        (0.25, 0.5, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0),
        (1.96, 1.86, 1.69, 1.57, 1.46, 1.31, 1.11, 0.83),
        (1.00, 0.98, 0.95, 0.93, 0.90, 0.86, 0.79, 0.66),
        strict=True,
    ),
)
def test_angle_rules_differ_as_published(ratio, paper, half):
    photo = make_photo(focal=1000 / ratio)
    exact = pixel_size(photo, angle="exact")
    assert exact == pytest.approx(10 / photo.lens.fx)
    assert pixel_size(photo, angle="paper") / exact == pytest.approx(paper, abs=6e-3)
    assert pixel_size(photo) / exact == pytest.approx(half, abs=6e-3)


@pytest.mark.parametrize("angle", ["half", "paper", "exact"])
def test_a_resized_photo_shows_the_same_physical_crops(angle):
    photo = make_photo(width=1600, height=1200)
    small = photo.resized(800, 600)
    assert pixel_size(small, angle=angle) * 800 == pytest.approx(
        pixel_size(photo, angle=angle) * 1600, rel=1e-6
    )
    sides = crop_sides([1.0, 2.0, 4.0], pixel_size(photo), photo.width)
    small_sides = crop_sides([1.0, 2.0, 4.0], pixel_size(small), small.width)
    assert small_sides == pytest.approx(np.array(sides) / 2, abs=1)
    assert small.pixels / [800, 600] == pytest.approx(photo.pixels / [1600, 1200])


def test_points_whose_pixels_are_not_recorded_count_where_the_camera_sees_them():
    """Scenes without a COLMAP model have points alone."""
    points, pixels = [(0, 0, 10), (0, 13.5, 30), (9, 0, 20)], [(500, 500), (500, 950), (950, 500)]
    recorded, bare = make_photo(points, pixels), make_photo(points, np.zeros((0, 2)))
    assert pixel_size(bare, "mean-inner") == pixel_size(recorded, "mean-inner")
    assert pixel_size(bare, "mean-inner") != pixel_size(bare, "mean")


def test_photos_without_tracks_fall_back_to_the_view_and_then_to_the_scene():
    tracked = make_photo(name="tracked.jpg")
    viewing = make_photo([], name="viewing.jpg")
    turned = replace(make_photo([], name="turned.jpg"), camera_from_world=np.diag([-1.0, 1, -1, 0])[:3])
    sizes, fallback = pixel_sizes(
        make_reconstruction(tracked, viewing, turned, points=[(0, 0, 30)]), angle="exact"
    )
    assert fallback == ["viewing.jpg", "turned.jpg"]
    assert sizes == pytest.approx({"tracked.jpg": 0.01, "viewing.jpg": 0.03, "turned.jpg": 0.02})


def test_a_scene_without_any_point_in_view_is_refused():
    with pytest.raises(UserError, match="no photo sees a 3D point"):
        pixel_sizes(make_reconstruction(make_photo([]), points=[(0, 0, -5)]))


def test_crop_sides_are_clipped_and_duplicates_at_the_ends_dropped():
    sides = crop_sides([0.1, 0.2, 0.5, 1.0, 9.0, 10.0], pixel_size=0.01, width=640)
    assert sides == [32, 50, 100, 640]


def test_crop_sides_survive_rounding_and_tiny_photos():
    assert 0.47 / 0.01 < 47
    assert crop_sides([0.47], pixel_size=0.01, width=640) == [47]
    assert crop_sides([0.1, 1.0], pixel_size=0.01, width=20) == [20]


def test_relative_crops_are_fractions_of_the_width():
    assert crop_sides(relative_scales(3, 0.1, 0.4), 1 / 1000, 1000) == [100, 200, 400]


def test_a_mixed_scene_reads_back(mixed_scene):
    reconstruction = read_reconstruction(mixed_scene / "sparse" / "0")
    photos = list(reconstruction.photos.values())
    assert [photo.name for photo in photos] == [f"photo_{i:03d}.jpg" for i in range(6)]
    assert len({(photo.width, photo.height, photo.lens.fx, photo.lens.cx) for photo in photos}) == 6
    assert {photo.width > photo.height for photo in photos} == {True, False}
    assert len(reconstruction.points) == len(reconstruction.colors) > 100
    for photo in photos:
        x, y, z = photo.camera_from_world @ np.column_stack([photo.points, np.ones(len(photo.points))]).T
        lens = photo.lens
        projected = np.column_stack([lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy])
        assert len(projected) > 20
        assert np.abs(projected - photo.pixels).max() < 1e-6
        assert photo.camera_from_world @ [*photo.center, 1] == pytest.approx(np.zeros(3), abs=1e-12)
        assert photo.lens.distortion == ()


def test_keypoints_without_a_finite_3d_point_are_left_out(scene, tmp_path):
    import pycolmap

    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    before = read_reconstruction(scene / "sparse" / "0")
    deleted, lost = [p.point3D_id for p in model.image(1).points2D if p.has_point3D()][:2]
    model.delete_point3D(deleted)
    model.point3D(lost).xyz = [np.nan, 0, 0]
    model.write_binary(tmp_path)
    after = read_reconstruction(tmp_path)
    assert len(after.points) == len(before.points) - 2
    name = "photo_000.jpg"
    assert len(after.photos[name].points) == len(before.photos[name].points) - 2
    assert all(size > 0 for size in pixel_sizes(after)[0].values())


def test_a_folder_without_a_model_says_what_was_looked_for(tmp_path):
    with pytest.raises(UserError, match=r"cameras, images and points3D.*lang3dxl reconstruct"):
        read_reconstruction(tmp_path)


def test_empty_and_damaged_models_are_refused(scene, tmp_path):
    import pycolmap

    pycolmap.Reconstruction().write_binary(tmp_path)
    with pytest.raises(UserError, match="no photo with a pose"):
        read_reconstruction(tmp_path)
    for file in (scene / "sparse" / "0").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    images = tmp_path / "images.bin"
    images.write_bytes(images.read_bytes()[:1000])
    with pytest.raises(UserError, match="damaged"):
        read_reconstruction(tmp_path)


@pytest.mark.parametrize(
    ("model", "params", "message"),
    [
        ("FOV", [100, 100, 50, 40, 0.9], "FOV camera.*image_undistorter"),
        ("PINHOLE", [0, 100, 50, 40], "impossible"),
    ],
)
def test_an_unusable_camera_is_named_with_its_photo(tmp_path, model, params, message):
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=model, width=100, height=80, params=params)
    )
    image = pycolmap.Image(name="odd.jpg", keypoints=np.zeros((0, 2)), camera_id=1, image_id=1)
    reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    reconstruction.write_binary(tmp_path)
    with pytest.raises(UserError, match=rf"odd\.jpg.*{message}"):
        read_reconstruction(tmp_path)


def test_pillow_writes_png_after_a_model_was_read(scene, tmp_path):
    code = f"""
from pathlib import Path
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.colmap import read_reconstruction
read_reconstruction(Path({str(scene)!r}) / "sparse" / "0")
import numpy as np
from PIL import Image
noise = np.random.default_rng(0).integers(0, 255, (300, 400), np.uint8)
Image.fromarray(noise).save({str(tmp_path / "a.png")!r})
"""
    root = Path(__file__).parents[2]
    subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=root, env={**os.environ, "PYTHONPATH": str(root)}
    )


def test_the_proposed_range_is_readable_and_shaped_like_the_published_ones(scene):
    reconstruction = read_reconstruction(scene / "sparse" / "0")
    sizes, _ = pixel_sizes(reconstruction)
    proposed = propose_scale_range(reconstruction, sizes)
    assert proposed.smallest >= 32 * np.median(list(sizes.values()))
    assert 4.5 <= proposed.largest / proposed.smallest <= 16
    assert f"{proposed.smallest:.3g}" in proposed.reason
    assert f"{proposed.largest:.3g}" in proposed.reason
    assert "\n" not in proposed.reason


def test_the_proposed_range_follows_the_photos_and_stops_at_the_building():
    photos = [make_photo(width=2000, focal=2000, name=f"{i}.jpg") for i in range(4)]
    city = np.random.default_rng(0).uniform(-100, 100, (500, 3))
    sizes = {photo.name: 0.005 for photo in photos}  # 10 units across
    free = propose_scale_range(make_reconstruction(*photos, points=city), sizes)
    assert (free.smallest, free.largest) == pytest.approx((0.5, 5.0))
    statue = np.array([[0, 0, 10.0]] * 50 + [[0, 0, 8.5], [0, 0, 11.5]] * 100 + [[1e9, 0, 0]] * 10)
    bounded = propose_scale_range(make_reconstruction(*photos, points=statue), sizes)
    assert (bounded.smallest, bounded.largest) == pytest.approx((0.5, 3.0))


def test_real_scenes_agree_on_the_physical_size(real_scenes):
    plain, wild = (
        read_reconstruction(real_scenes / name / "sparse" / "0") for name in ("sceaux", "sceaux_wild")
    )
    plain_sizes, wild_sizes = pixel_sizes(plain)[0], pixel_sizes(wild)[0]
    for name, size in plain_sizes.items():
        focal_ratio = wild.photos[name].lens.fx / plain.photos[name].lens.fx
        # A cropped photo has fewer tracks and a smaller field of view: some per cent, no more.
        assert wild_sizes[name] * focal_ratio == pytest.approx(size, rel=0.1)
    proposals = [propose_scale_range(plain, plain_sizes), propose_scale_range(wild, wild_sizes)]
    assert proposals[0].smallest == pytest.approx(proposals[1].smallest, rel=0.15)
    assert proposals[0].largest == pytest.approx(proposals[1].largest, rel=0.15)
