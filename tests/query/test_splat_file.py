"""The splat PLY, read back by an independent reader."""

import numpy as np
import pytest
import torch

from lang3dxl_ns.query.splat_file import write_splats


@pytest.fixture(params=[0, 1, 3])
def gaussians(request):
    g, n = torch.Generator().manual_seed(0), 7
    shapes = {"means": (3,), "features_dc": (3,), "features_rest": ((request.param + 1) ** 2 - 1, 3),
              "opacities": (1,), "scales": (3,), "quats": (4,)}  # fmt: skip
    return {name: torch.randn(n, *shape, generator=g) for name, shape in shapes.items()}


def read(path) -> np.ndarray:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode().split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    rows = np.frombuffer(body, dtype=[(name, "<f4") for name in names])
    assert f"element vertex {len(rows)}" in lines
    return rows


def test_every_property_is_in_its_place(gaussians, tmp_path):
    assert write_splats(tmp_path / "all.ply", gaussians) == 7
    rows = read(tmp_path / "all.ply")
    coefficients = gaussians["features_rest"].shape[1]
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [f"f_rest_{i}" for i in range(3 * coefficients)]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert list(rows.dtype.names) == expected
    np.testing.assert_array_equal(rows["y"], gaussians["means"][:, 1])
    np.testing.assert_array_equal(rows["opacity"], gaussians["opacities"][:, 0])
    for channel in range(3 if coefficients else 0):
        first = rows[f"f_rest_{channel * coefficients}"]
        np.testing.assert_array_equal(first, gaussians["features_rest"][:, 0, channel])
    color = 0.5 + 0.28209479177387814 * rows["f_dc_0"]
    base = gaussians["features_dc"][:, 0]
    expected_color = 0.5 + 0.28209479177387814 * base if coefficients else base.sigmoid()
    np.testing.assert_allclose(color, expected_color, atol=1e-6)


def test_only_the_matching_ones_or_all_with_their_scores(gaussians, tmp_path):
    scores = torch.linspace(0, 1, 7)
    assert write_splats(tmp_path / "some.ply", gaussians, keep=scores > 0.6) == 3
    np.testing.assert_array_equal(read(tmp_path / "some.ply")["x"], gaussians["means"][4:, 0])
    assert write_splats(tmp_path / "all.ply", gaussians, scores=scores) == 7
    np.testing.assert_array_equal(read(tmp_path / "all.ply")["score"], scores)


def test_broken_gaussians_stay_out(gaussians, tmp_path):
    gaussians["scales"][2, 1] = float("nan")
    assert write_splats(tmp_path / "all.ply", gaussians) == 6
