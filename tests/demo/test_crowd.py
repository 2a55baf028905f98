"""Synthetic collections for the scale benchmark, and its report."""

from pathlib import Path

import numpy as np
from PIL import Image

from lang3dxl_ns.benchmarks.scale import ScaleBenchmark, markdown
from lang3dxl_ns.demo.landmark.crowd import SIZES, write_crowd
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


def test_the_report_holds_a_row_per_measurement_and_the_prediction():
    row = dict.fromkeys(("preparation_s", "step_s", "data_s"), 0.25)
    row |= dict.fromkeys(
        (f"{part}_bytes" for part in ("preparation", "training", "evaluation", "store")), 3e8
    )
    row |= {"photos": 1234, "gaussians": 56789}
    pairs = [
        {"out of core": row | {"step_s": 0.1 * n}, "in memory": row | {"step_s": 0.1}} for n in (1, 3, 2)
    ]
    workers = [{"workers": 2, "seconds": 50.0, "photos_per_second": 4.0}]
    rows = {"photos": [row], "pairs": pairs, "workers": workers, "gaussians": [row]}
    report = markdown(ScaleBenchmark(out=Path("x")), rows)
    assert "1,234, in memory | 0 | 300 | 300 | 300 | 100" in report
    assert "2.000 of the time of one in memory (median of 3 pairs, 1.000 to 3.000)" in report
    assert "| 2 | 50 | 4.0 |" in report
    assert "| 56,789 |" in report
    assert "Written before measuring" in report
