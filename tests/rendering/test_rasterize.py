"""The tiled rasterizer against the dense reference, and the laws of compositing."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from splat_clouds import Cloud, gradients, make_cloud, maps, relative_error

from lab.numerics.rasterizer_reference import rasterize_reference
from lang3dxl_ns.rendering import rasterize
from lang3dxl_ns.rendering.rasterize import at_fewer_pixels

pytestmark = pytest.mark.usefixtures("backend")
MODES = [{}, {"antialiased": True}, {"near": 1.5, "eps2d": 0.1}]


def check_float32(cloud: Cloud):
    """Float32 against the reference in float64.

    A pair at the threshold of 1/255, or two Gaussians at nearly one depth, may go either way in float32,
    which shows in the pixel and its gradient; so up to one pixel in a thousand may differ, by
    little, and is left out then.
    """
    exact, single = cloud.leaves(), cloud.leaves(torch.float32)
    expected, found = cloud.render(rasterize_reference, exact), cloud.render(rasterize, single)
    errors = {
        name: (getattr(found, name).double() - value).abs().amax(2) / max(1, value.detach().max())
        for name, value in maps(expected).items()
    }
    flipped = torch.stack(list(errors.values())).amax(0) > 1e-5
    assert flipped.double().mean() <= 1e-3
    for name, error in errors.items():
        assert error.max() < 5e-3, name
        assert error[~flipped].mean() <= 1e-6, name

    expected_gradients = gradients(expected, exact, pixels=~flipped)
    for name, value in gradients(found, single, pixels=~flipped).items():
        assert relative_error(value, expected_gradients[name]) <= 1e-5, name


@pytest.mark.slow
@pytest.mark.skipif("LANG3DXL_REAL_SCENES" not in os.environ, reason="LANG3DXL_REAL_SCENES is not set")
def test_float32_agrees_with_the_reference_on_a_real_scene():
    import numpy as np

    file = np.load(Path(os.environ["LANG3DXL_REAL_SCENES"]) / "garden" / "test_garden.npz")
    means = torch.from_numpy(file["means3d"]).double()
    means = means[(means.abs() < 2).all(1)]
    cloud = make_cloud(5000, 112, 84, size=0.01)
    cloud.tensors["means"] = means[
        torch.randperm(len(means), generator=torch.Generator().manual_seed(0))[:5000]
    ]
    cloud.tensors["view_matrix"] = torch.from_numpy(file["viewmats"][0]).double()
    scale = torch.tensor([112 / int(file["width"]), 84 / int(file["height"]), 1.0], dtype=torch.float64)
    cloud.intrinsics = scale[:, None] * torch.from_numpy(file["Ks"][0]).double()
    check_float32(cloud)


@pytest.mark.parametrize("mode", MODES)
def test_float64_equals_the_reference_in_every_map_and_gradient(mode):
    cloud = make_cloud(400, 45, 37, size=0.08)
    ours, theirs = cloud.leaves(), cloud.leaves()
    expected, found = cloud.render(rasterize_reference, theirs, **mode), cloud.render(rasterize, ours, **mode)
    for name, value in maps(expected).items():
        torch.testing.assert_close(getattr(found, name), value, atol=1e-10, rtol=0)
    expected_gradients = gradients(expected, theirs)
    for name, value in gradients(found, ours).items():
        assert expected_gradients[name].norm() > 0
        assert relative_error(value, expected_gradients[name]) < 1e-9, name


@pytest.mark.parametrize("size", [0.015, 0.5])
def test_float64_equals_the_reference_for_small_splats_and_for_dense_fog(size):
    # In fog nearly every pixel stops before its last Gaussian.
    cloud = make_cloud(300, 34, 26, size=size)
    ours, theirs = cloud.leaves(), cloud.leaves()
    expected, found = cloud.render(rasterize_reference, theirs), cloud.render(rasterize, ours)
    torch.testing.assert_close(found.image, expected.image, atol=1e-10, rtol=0)
    expected_gradients = gradients(expected, theirs)
    for name, value in gradients(found, ours).items():
        assert relative_error(value, expected_gradients[name]) < 1e-9, name


def test_every_channel_is_rendered_as_alone_and_reaches_geometry_and_opacity():
    cloud = make_cloud(300, 40, 30)
    leaves = cloud.leaves(torch.float32)
    together = cloud.render(rasterize, leaves)
    for some in (slice(0, 3), slice(3, 5)):
        part = leaves | {name: leaves[name][..., some] for name in ("channels", "background")}
        alone = cloud.render(rasterize, part).image
        torch.testing.assert_close(together.image[..., some], alone, atol=1e-6, rtol=1e-5)
        slopes = torch.autograd.grad(alone.square().sum(), list(leaves.values()), retain_graph=True)
        assert all(slope.norm() > 0 for slope in slopes)


def test_at_fewer_pixels_the_same_ellipses_are_drawn():
    """With the blur of the large picture, a picture of every fifth pixel is its every fifth pixel."""
    cloud = make_cloud(300, 45, 35)
    leaves = cloud.leaves()
    large = cloud.render(rasterize, leaves, antialiased=True)
    view, eps2d = at_fewer_pixels(cloud.camera(leaves), 7, 9)
    small = replace(cloud, width=9, height=7, intrinsics=view.intrinsics)
    found = small.render(rasterize, leaves, eps2d=eps2d, antialiased=True)
    for name, value in maps(found).items():
        torch.testing.assert_close(value, getattr(large, name)[2::5, 2::5], atol=1e-10, rtol=0)


def test_the_order_in_which_gaussians_are_given_does_not_matter():
    cloud = make_cloud(300, 40, 30)
    shuffled = make_cloud(300, 40, 30)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(2))
    for name in ("means", "quats", "scales", "opacities", "channels"):
        shuffled.tensors[name] = shuffled.tensors[name][order]
    a, b = (scene.render(rasterize, scene.leaves(torch.float32)) for scene in (cloud, shuffled))
    for name, value in maps(a).items():
        torch.testing.assert_close(getattr(b, name), value, atol=1e-5, rtol=1e-5)


def test_the_length_of_a_quaternion_does_not_matter():
    cloud = make_cloud(300, 40, 30)
    expected = cloud.render(rasterize, cloud.leaves()).image
    cloud.tensors["quats"] = 5 * cloud.tensors["quats"]
    torch.testing.assert_close(cloud.render(rasterize, cloud.leaves()).image, expected)


def test_alpha_is_the_image_of_white_gaussians_over_black():
    cloud = make_cloud(300, 40, 30)
    cloud.tensors["channels"] = torch.ones(300, 1, dtype=torch.float64)
    cloud.tensors["background"] = torch.zeros(1, dtype=torch.float64)
    rendering = cloud.render(rasterize, cloud.leaves())
    torch.testing.assert_close(rendering.image, rendering.alpha)
    assert 0 < rendering.alpha.max().item() <= 1 - 1e-4


def test_depth_is_that_of_the_one_gaussian_and_zero_beside_it():
    cloud = make_cloud(1, 40, 30, size=0.02)
    cloud.tensors["means"] = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64)
    cloud.tensors["opacities"] = torch.tensor([0.7], dtype=torch.float64)
    leaves = cloud.leaves()
    rendering = cloud.render(rasterize, leaves)
    z = float((cloud.tensors["view_matrix"] @ torch.tensor([0.0, 0, 2, 1], dtype=torch.float64))[2])
    covered = rendering.alpha > 0
    assert 0 < covered.sum() < covered.numel()
    torch.testing.assert_close(rendering.depth[covered], torch.full_like(rendering.depth[covered], z))
    assert not rendering.depth[~covered].any()


def test_the_gradient_of_screen_positions_is_that_of_shifting_the_principal_point():
    cloud = make_cloud(200, 40, 30)
    leaves = cloud.leaves()
    rendering = cloud.render(rasterize, leaves)
    means2d = rendering.info["means2d"]
    means2d.retain_grad()
    rendering.image[..., :3].square().sum().backward()
    assert means2d.grad.shape == (1, 200, 2)

    def loss(shift: float) -> float:
        moved = Cloud(cloud.tensors, cloud.intrinsics.clone(), cloud.width, cloud.height)
        moved.intrinsics[0, 2] += shift
        return float(moved.render(rasterize, moved.tensors).image[..., :3].square().sum())

    # The principal point also moves the clamp of the Jacobian, but only for Gaussians far outside.
    numeric = (loss(1e-5) - loss(-1e-5)) / 2e-5
    assert float(means2d.grad[..., 0].sum()) == pytest.approx(numeric, rel=1e-3)
