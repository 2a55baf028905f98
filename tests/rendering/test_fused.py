"""The compiled kernels: their exponential, threads, memory."""

import numba
import numpy as np
import pytest
import torch
from splat_clouds import gaussians, gradients, make_cloud, maps

from lang3dxl_ns.rendering import (
    Gaussians,
    Raster,
    fused_compositing,
    fused_projection,
    projection,
    rasterize,
)
from lang3dxl_ns.rendering.fused_compositing import FusedCompositing
from lang3dxl_ns.rendering.rasterize import EPS2D
from lang3dxl_ns.rendering.simd import LANES, exp2, load, store
from lang3dxl_ns.rendering.torch_rasterizer import Compositing
from lang3dxl_ns.scene.camera import Camera


@numba.njit
def powers(exponents, out):
    for i in range(0, len(exponents), LANES):
        store(out, i, exp2(load(exponents, i)))


@pytest.mark.parametrize(("dtype", "bound"), [(np.float32, 3e-7), (np.float64, 3e-15)])
def test_the_power_of_two_is_right_to_rounding(dtype, bound):
    exponents = np.linspace(-100, 1, LANES * 4001).astype(dtype)
    found = np.empty_like(exponents)
    powers(exponents, found)
    assert np.abs(found / np.exp2(exponents.astype(np.longdouble)) - 1).max() < bound


def rendered(cloud, threads, **settings):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        leaves = cloud.leaves(torch.float32)
        rendering = cloud.render(rasterize, leaves, backend="numba", **settings)
        return maps(rendering), gradients(rendering, leaves)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(("count", "size"), [(2000, 0.06), (12_000, 0.02)])
def test_any_number_of_threads_gives_the_same(count, size):
    """Many enough in the second case that threads share their packing and collecting."""
    cloud = make_cloud(count, 70, 50, size=size)
    alone, alone_gradients = rendered(cloud, 1)
    for threads in (2, 5):
        found, found_gradients = rendered(cloud, threads)
        _, again_gradients = rendered(cloud, threads)
        for name, value in alone.items():
            assert torch.equal(found[name], value), name
        for name, value in alone_gradients.items():
            torch.testing.assert_close(found_gradients[name], value, rtol=1e-4, atol=1e-5)
            assert torch.equal(found_gradients[name], again_gradients[name]), name


def test_what_an_earlier_scene_left_in_kept_memory_changes_nothing(monkeypatch):
    small = make_cloud(200, 40, 30)
    rendered(make_cloud(2000, 70, 50, size=0.06), 2)
    _, after_a_larger_one = rendered(small, 2)
    monkeypatch.setattr(fused_compositing, "_MOST_KEPT", 0)
    _, in_memory_of_its_own = rendered(small, 2)
    for name, value in in_memory_of_its_own.items():
        assert torch.equal(after_a_larger_one[name], value), name


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 9, 16])
def test_any_number_of_channels_equals_the_torch_kernels(channels):
    cloud = make_cloud(200, 40, 30)
    generator = torch.Generator().manual_seed(5)
    cloud.tensors["channels"] = torch.rand(200, channels, generator=generator).double()
    cloud.tensors["background"] = torch.rand(channels, generator=generator).double()
    ours, theirs = cloud.leaves(), cloud.leaves()
    found = cloud.render(rasterize, ours, backend="numba")
    expected = cloud.render(rasterize, theirs, backend="torch")
    for name, value in maps(expected).items():
        torch.testing.assert_close(getattr(found, name), value, atol=1e-10, rtol=0)
    expected_gradients = gradients(expected, theirs)
    for name, value in gradients(found, ours).items():
        torch.testing.assert_close(value, expected_gradients[name], atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("size", [1e3, 1e5])
def test_huge_ellipses_have_exact_gradients_in_float32(size, antialiased):
    """Standard deviations of 1e4 to 1e7 pixels."""
    cloud = make_cloud(60, 32, 24)
    cloud.tensors["scales"] = size * torch.tensor([1.0, 2.0, 0.5]).double().expand(60, 3)
    exact, single = cloud.leaves(), cloud.leaves(torch.float32)
    settings = {"backend": "numba", "antialiased": antialiased}
    expected = gradients(cloud.render(rasterize, exact, **settings), exact)
    found = gradients(cloud.render(rasterize, single, **settings), single)
    for name in ("means", "quats", "scales", "opacities"):
        assert (found[name].double() - expected[name]).norm() <= 1e-5 * expected[name].norm(), name


def test_a_flat_ellipse_without_blur_has_finite_gradients():
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 8.5], [0, 20, 8.5], [0, 0, 1]]), 16, 16)
    parts = torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[0.1, 0, 0]])
    leaves = [part.requires_grad_() for part in (*parts, torch.tensor([0.8]))]
    raster = rasterize(Gaussians(*leaves), camera, torch.ones(1, 3), eps2d=0.0, backend="numba")
    for gradient in torch.autograd.grad(raster.image.sum(), leaves):
        assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("to_screen", [projection.project, fused_projection.project])
@pytest.mark.parametrize("compositing", [Compositing, FusedCompositing])
def test_either_projection_goes_with_either_compositing(to_screen, compositing):
    cloud = make_cloud(200, 40, 30)
    found, expected = cloud.leaves(), cloud.leaves()
    ellipses = to_screen(gaussians(found), cloud.camera(found), near=0.01, eps2d=EPS2D, antialiased=True)
    image, alpha = compositing.apply(
        ellipses.means2d, ellipses.conics, ellipses.opacities, found["channels"], ellipses.variances,
        ellipses.depths, cloud.width, cloud.height,
    )  # fmt: skip
    image = image + (1 - alpha) * found["background"]
    settings = {"backend": "torch", "antialiased": True, "render_depth": False}
    expected_gradients = gradients(cloud.render(rasterize, expected, **settings), expected)
    for name, value in gradients(Raster(image, alpha, None), found).items():
        torch.testing.assert_close(value, expected_gradients[name], atol=1e-9, rtol=1e-9)


def test_gaussians_close_to_the_camera_take_four_bytes_a_tile(monkeypatch):
    make, plans = fused_compositing.make_plan, []

    def kept(*arguments):
        plans.append(make(*arguments))
        return plans[-1]

    monkeypatch.setattr("lang3dxl_ns.rendering.fused_compositing.make_plan", kept)
    cloud = make_cloud(3000, 320, 240, size=0.02)
    cloud.tensors["means"] *= 0.02
    cloud.tensors["view_matrix"][:3, 3] *= 0.02
    leaves = cloud.leaves(torch.float32)
    cloud.render(rasterize, leaves, backend="numba").image.sum().backward()
    assert plans[0].ranks.nbytes <= 4 * 3000 * 20 * 15
    assert bool(leaves["means"].grad.isfinite().all())


def test_sums_of_many_threads_are_bounded_by_bytes(monkeypatch):
    """Of 16 threads only as many keep sums of their own as fit, and the gradients stay the same."""
    cloud, shapes = make_cloud(2000, 70, 50, size=0.06), []
    _, expected = rendered(cloud, 1)
    take = fused_compositing._Kept.take

    def watched(self, shape, dtype):
        shapes.append(shape)
        return take(self, shape, dtype)

    monkeypatch.setattr(fused_compositing._Kept, "take", watched)
    _, found = rendered(cloud, 16)
    copies, *each = shapes.pop()
    assert copies == 16
    for most in (3.5, 0.5):
        monkeypatch.setattr(fused_compositing, "MOST_SUMS", int(most * 4 * each[0] * each[1]))
        _, bounded = rendered(cloud, 16)
        assert shapes.pop()[0] == max(int(most), 1)
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(bounded[name], value, rtol=1e-4, atol=1e-5)
