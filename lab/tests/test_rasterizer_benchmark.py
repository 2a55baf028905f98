"""Laws of the rasterizer benchmark: its scenes, its independent baseline, its report."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from lab.benchmarks import rasterizer as benchmark
from lab.benchmarks.dense_rasterizer import count_pairs, render_dense
from lab.benchmarks.rasterizer import (
    DENSE,
    OURS,
    TORCH,
    RasterizerBenchmark,
    error_against,
    forward_backward,
    pass_costs,
)
from lab.benchmarks.rasterizer_scenes import Case, make_problem, synthetic_cloud
from lang3dxl_ns.common.errors import UserError

SMALL = [Case("A", 400, 50, 37), Case("B", 400, 50, 37)]


@pytest.fixture
def float64_problem():
    return make_problem(SMALL[1], None, dtype=torch.float64)


def save_cloud(path: Path, count: int) -> Path:
    points, camera = synthetic_cloud(count, torch.Generator().manual_seed(3))
    far = torch.full((5, 3), 7.0)
    arrays = {"means3d": torch.cat([points, far]), "viewmats": camera.view_matrix[None]}
    np.savez(path, **arrays, Ks=camera.intrinsics[None], width=camera.width, height=camera.height)
    return path


@pytest.mark.parametrize("case", SMALL)
def test_the_dense_baseline_and_the_rasterizer_agree_in_float64(case):
    problem = make_problem(case, None, dtype=torch.float64)
    error = error_against(forward_backward(problem, OURS), forward_backward(problem, DENSE))
    assert error["image_max"] < 1e-9
    assert error["gradient"] < 1e-7


def test_the_dense_baseline_over_a_background_of_one_color_keeps_that_color(float64_problem):
    problem = dataclasses.replace(
        float64_problem,
        channels=torch.full_like(float64_problem.channels, 0.3),
        background=torch.full_like(float64_problem.background, 0.3),
    )
    image, alpha = render_dense(problem)
    torch.testing.assert_close(image, torch.full_like(image, 0.3))
    assert alpha.max() > 0.9


def test_the_baseline_does_not_depend_on_its_tile_size(float64_problem, monkeypatch):
    image, _ = render_dense(float64_problem)
    scene = float64_problem.gaussians, float64_problem.camera
    kept, evaluated = count_pairs(*scene)
    monkeypatch.setattr("lab.benchmarks.dense_rasterizer.DENSE_TILE", 50)
    torch.testing.assert_close(render_dense(float64_problem)[0], image)
    assert count_pairs(*scene)[0] == kept
    assert kept < evaluated < count_pairs(*scene)[1]


def test_a_problem_is_the_same_for_the_same_seed_and_another_for_another():
    first, again, other = (make_problem(SMALL[0], None, seed=seed) for seed in (0, 0, 1))
    for one, same, different in zip(first.leaves, again.leaves, other.leaves, strict=True):
        assert torch.equal(one, same)
        assert not torch.equal(one, different)


def test_the_made_scene_lies_within_two_units_and_mostly_in_view():
    points, camera = synthetic_cloud(2000, torch.Generator().manual_seed(0))
    assert points.shape == (2000, 3)
    assert points.abs().max() <= 2
    in_camera = points @ camera.view_matrix[:3, :3].T + camera.view_matrix[:3, 3]
    x, y, z = (in_camera @ camera.intrinsics.T).unbind(1)
    seen = (z > 0) & (x > 0) & (x < camera.width * z) & (y > 0) & (y < camera.height * z)
    assert 0.4 < seen.float().mean() < 0.9


def test_a_scene_file_gives_its_points_within_two_units(tmp_path):
    problem = make_problem(Case("A", 300, 32, 24), save_cloud(tmp_path / "cloud.npz", 300))
    assert problem.gaussians.means.abs().max() <= 2


def test_too_few_points_name_the_file_and_the_remedy(tmp_path):
    scene = save_cloud(tmp_path / "cloud.npz", 100)
    with pytest.raises(UserError, match=r"cloud\.npz has 100 points .* fewer than 300: lower --gaussians"):
        make_problem(Case("A", 300, 32, 24), scene)


def test_a_file_that_is_not_a_scene_is_named(tmp_path):
    np.savez(tmp_path / "other.npz", points=np.zeros(3))
    for name in ("other.npz", "missing.npz"):
        with pytest.raises(UserError, match=name):
            make_problem(SMALL[0], tmp_path / name)


def test_error_is_zero_against_itself_and_counts_what_is_off():
    image, gradient = torch.rand(4, 5, 6), torch.tensor([3.0, 4.0])
    assert set(error_against((image, (gradient,)), (image, (gradient,))).values()) == {0}
    off = image.clone()
    off[0, 0, 2] += 0.01
    error = error_against((off, (gradient * 1.5,)), (image, (gradient,)))
    assert error["pixels_off"] == 1
    assert error["image_max"] == pytest.approx(0.01, rel=1e-4)
    assert error["image_mean"] == pytest.approx(0.01 / image.numel(), rel=1e-4)
    assert error["gradient"] == pytest.approx(0.5)


def test_one_pass_and_two_give_the_same_gradients(float64_problem):
    alone, one, two, small = (work() for work in pass_costs(float64_problem).values())
    for mine, other in zip(one, two, strict=True):
        torch.testing.assert_close(mine, other)
    assert not torch.allclose(alone[0], one[0])
    assert not torch.allclose(alone[0], small[0])


def test_the_quick_benchmark_reports_times_ratios_errors_and_memory(tmp_path):
    RasterizerBenchmark(tmp_path, quick=True, device="cpu").main()
    report, data = (
        (tmp_path / "rasterizer.md").read_text(),
        json.loads((tmp_path / "rasterizer.json").read_text()),
    )
    assert f"`python -m lab.benchmarks.rasterizer --out {tmp_path} --device cpu --quick`" in report
    assert (tmp_path / "rasterizer.png").read_bytes().startswith(b"\x89PNG")
    for case in data["cases"]:
        ratio = case["forward_backward_ms"][DENSE] / case["forward_backward_ms"][OURS]
        assert f" / {ratio:,.{1 if ratio < 10 else 0}f} |" in report
        assert case["error"][OURS]["image_mean"] < 1e-5
        assert case["peak_mib"][DENSE] > case["peak_mib"][OURS] >= 0


def test_a_baseline_that_needs_too_much_memory_is_left_out_and_said_so(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "peak_memory", lambda *_: 0)
    RasterizerBenchmark(tmp_path, quick=True, device="cpu", baseline_gigabytes=0).main()
    case = json.loads((tmp_path / "rasterizer.json").read_text())["cases"][0]
    assert set(case["forward_ms"]) == {OURS, TORCH, DENSE}
    assert set(case["forward_backward_ms"]) == {OURS, TORCH}
    assert "would need more than 0 GB" in (tmp_path / "rasterizer.md").read_text()
