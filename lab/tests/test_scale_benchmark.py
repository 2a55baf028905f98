"""Synthetic collections for the scale benchmark."""

import numpy as np
from PIL import Image

from lab.benchmarks.crowd import SIZES, write_crowd
from lang3dxl_ns.scene.colmap import read_reconstruction


def test_a_crowd_is_a_scene_of_mixed_sizes_with_tracks_and_depends_on_its_seed_alone(tmp_path):
    scenes = [
        write_crowd(tmp_path / str(i), photos=12, points=100, seed=seed) for i, seed in enumerate((1, 1, 2))
    ]
    model = read_reconstruction(scenes[0] / "sparse" / "0")
    assert len(model.photos) == 12
    assert len(model.points) == 100
    assert {(photo.width, photo.height) for photo in model.photos.values()} == set(SIZES)
    for photo in model.photos.values():
        assert len(photo.points) >= 20
        x, _y, z = photo.camera_from_world @ np.column_stack([photo.points, np.ones(len(photo.points))]).T
        assert np.allclose(photo.lens.fx * x / z + photo.lens.cx, photo.pixels[:, 0], atol=1e-3)
        with Image.open(scenes[0] / "images" / photo.name) as image:
            assert image.size == (photo.width, photo.height)
    first, again, other = ([p.read_bytes() for p in sorted(s.rglob("*.jpg"))] for s in scenes)
    assert first == again != other


def test_zoomed_photos_have_more_pixels_and_as_many_tracks(tmp_path):
    model = read_reconstruction(write_crowd(tmp_path / "3", 5, 50, zoom=3) / "sparse" / "0")
    assert [(p.width, p.height) for p in model.photos.values()] == [(3 * w, 3 * h) for w, h in SIZES]
    assert all(len(photo.points) >= 15 for photo in model.photos.values())
