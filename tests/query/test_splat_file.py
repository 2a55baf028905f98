"""Splat files: read back, they hold what was written."""

import numpy as np
import pytest
import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.splat_file import log_scales, write_splats
from lang3dxl_ns.rendering import Splats

GRAY = 0.28209479177387814
RELEVANCY = torch.linspace(0, 1, 7)


@pytest.fixture(params=[0, 3], ids=["degree-0", "degree-1"])
def splats(request) -> Splats:
    g = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(7, *shape, generator=g)

    quats = torch.nn.functional.normalize(rand(4) - 0.5, dim=1)
    return Splats(rand(3) * 4 - 2, quats, rand(3) + 0.01, rand(), rand(1 + request.param, 3) - 0.5)


def read(path) -> np.ndarray:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode().split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    rows = np.frombuffer(body, dtype=[(name, "<f4") for name in names])
    assert f"element vertex {len(rows)}" in lines
    return rows


def test_every_property_of_a_ply_is_in_its_place(splats, tmp_path):
    assert write_splats(tmp_path / "all.ply", splats, RELEVANCY) == 7
    rows = read(tmp_path / "all.ply")
    extra = splats.harmonics.shape[1] - 1
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [f"f_rest_{i}" for i in range(3 * extra)]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "relevancy"]
    assert list(rows.dtype.names) == expected
    np.testing.assert_array_equal(rows["y"], splats.means[:, 1])
    np.testing.assert_allclose(1 / (1 + np.exp(-rows["opacity"])), splats.opacities, atol=1e-5)
    np.testing.assert_allclose(np.exp(rows["scale_1"]), splats.scales[:, 1], rtol=1e-5)
    np.testing.assert_array_equal(rows["relevancy"], RELEVANCY)
    for channel in range(3 if extra else 0):
        first = rows[f"f_rest_{channel * extra}"]
        np.testing.assert_array_equal(first, splats.harmonics[:, 1, channel])
    np.testing.assert_array_equal(rows["f_dc_2"], splats.harmonics[:, 0, 2])


def test_an_spz_file_is_read_back_by_its_library(splats, tmp_path):
    gsply = pytest.importorskip("gsply")
    assert write_splats(tmp_path / "all.spz", splats) == 7
    found = gsply.read_spz(tmp_path / "all.spz")
    np.testing.assert_allclose(found.means, splats.means, atol=1e-5)
    np.testing.assert_allclose(found.scales, log_scales(splats), atol=1 / 16)
    opacities = 1 / (1 + np.exp(-np.asarray(found.opacities).reshape(-1)))
    np.testing.assert_allclose(opacities, splats.opacities, atol=1 / 255)
    colors = 0.5 + GRAY * np.asarray(found.sh0)
    np.testing.assert_allclose(colors, 0.5 + GRAY * splats.harmonics[:, 0], atol=0.005)
    same = np.abs((np.asarray(found.quats) * splats.quats.numpy()).sum(1))  # q and −q are one rotation
    np.testing.assert_allclose(same, 1, atol=0.01)


def test_broken_gaussians_stay_out(splats, tmp_path):
    splats.scales[2, 1] = float("nan")
    assert write_splats(tmp_path / "all.ply", splats, RELEVANCY) == 6
    np.testing.assert_array_equal(read(tmp_path / "all.ply")["relevancy"], RELEVANCY[[0, 1, 3, 4, 5, 6]])


def test_other_kinds_of_files_are_refused(splats, tmp_path):
    with pytest.raises(UserError, match=r"end it in .ply or .spz"):
        write_splats(tmp_path / "all.obj", splats)
