"""Rasterization of degenerate and extreme scenes."""

import pytest
import torch
from splat_clouds import gaussians, gradients, make_cloud, maps, relative_error

from lab.numerics.rasterizer_reference import rasterize_reference
from lang3dxl_ns.rendering import Gaussians, rasterize, torch_rasterizer
from lang3dxl_ns.scene.camera import Camera

pytestmark = pytest.mark.usefixtures("backend")


def assert_all_finite(rendering, leaves):
    for name, value in maps(rendering).items():
        assert bool(value.isfinite().all()), name
    found = gradients(rendering, leaves)
    for name, value in found.items():
        assert bool(value.isfinite().all()), name
    return found


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 50), (8, 8), (41, 4), (17, 31)])
def test_any_image_size_equals_the_reference(width, height):
    cloud = make_cloud(60, width, height, size=0.3)
    ours, theirs = cloud.leaves(), cloud.leaves()
    expected, found = cloud.render(rasterize_reference, theirs), cloud.render(rasterize, ours)
    assert found.image.shape == (height, width, 5)
    torch.testing.assert_close(found.image, expected.image, atol=1e-10, rtol=0)
    expected_gradients = gradients(expected, theirs)
    for name, value in gradients(found, ours).items():
        assert relative_error(value, expected_gradients[name]) < 1e-8, name


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_shapes_have_finite_gradients(dtype, antialiased):
    cloud = make_cloud(120, 40, 30)
    cloud.tensors["quats"][:20] = 0
    cloud.tensors["scales"][20:40] = 0
    cloud.tensors["scales"][40:60] = torch.tensor([1e-6, 1e-6, 5.0])
    cloud.tensors["scales"][60:70] = 1e20
    leaves = cloud.leaves(dtype)
    assert_all_finite(cloud.render(rasterize, leaves, antialiased=antialiased), leaves)


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities"])
def test_broken_gaussians_are_left_out_and_get_no_gradient(name, broken):
    cloud, rest = make_cloud(60, 30, 20), make_cloud(60, 30, 20)
    rest.tensors["opacities"][:10] = 0
    expected = rest.render(rasterize, rest.leaves(torch.float32))
    cloud.tensors[name][:10] = broken
    leaves = cloud.leaves(torch.float32)
    rendering = cloud.render(rasterize, leaves)
    torch.testing.assert_close(rendering.image, expected.image)
    found = assert_all_finite(rendering, leaves)
    for parameter in ("means", "quats", "scales", "opacities"):
        assert not found[parameter][:10].any()
        assert found[parameter][10:].any()


@pytest.mark.parametrize("channel", [0, 4])
@pytest.mark.parametrize("broken", [float("nan"), float("inf"), float("-inf")])
def test_a_gaussian_of_broken_colors_is_left_out_alone(channel, broken):
    """The picture is that of the others: no pixel of its tiles is spoiled."""
    cloud = make_cloud(40, 24, 20, size=0.3)
    without = cloud.leaves(torch.float32)
    with torch.no_grad():
        without["opacities"][3] = 0
    expected = cloud.render(rasterize, without)
    ours = cloud.leaves(torch.float32)
    with torch.no_grad():
        ours["channels"][3, channel] = broken
    found = cloud.render(rasterize, ours)
    for key, value in maps(found).items():
        torch.testing.assert_close(value, maps(expected)[key])
    assert not assert_all_finite(found, ours)["means"][3].any()


@pytest.mark.parametrize("part", ["view_matrix", "intrinsics"])
@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_a_broken_camera_is_an_error(part, broken):
    cloud = make_cloud(5, 8, 8)
    (cloud.intrinsics if part == "intrinsics" else cloud.tensors[part])[0, 2] = broken
    with pytest.raises(ValueError, match="camera has a NaN"):
        cloud.render(rasterize, cloud.leaves())


def test_broken_colors_of_unseen_gaussians_do_no_harm():
    cloud = make_cloud(60, 30, 20)
    cloud.tensors["means"][:10, 2] = -5
    cloud.tensors["channels"][:10] = float("nan")
    leaves = cloud.leaves(torch.float32)
    assert_all_finite(cloud.render(rasterize, leaves), leaves)


def test_a_long_needle_is_as_exact_in_float32_far_from_its_center():
    # Center 2900 px outside the image, standard deviation 3000 px along a slanted axis.
    camera = Camera(torch.eye(4), torch.tensor([[100.0, 0, 16], [0, 100.0, 16], [0, 0, 1]]), 32, 32)
    direction = torch.nn.functional.normalize(torch.tensor([0.9, 0.43, 0.0]), dim=0)
    half = torch.atan2(direction[1], direction[0]) / 2
    needle = Gaussians(
        (10 * 29 * direction + torch.tensor([0, 0, 10.0]))[None],
        torch.stack([half.cos(), half * 0, half * 0, half.sin()])[None],
        torch.tensor([[300.0, 1e-3, 1e-3]]),
        torch.tensor([0.9]),
    )
    exact = Gaussians(*(value.double() for value in vars(needle).values()))
    exact_camera = Camera(camera.view_matrix.double(), camera.intrinsics.double(), 32, 32)
    image = rasterize(needle, camera, torch.ones(1, 1)).image
    expected = rasterize_reference(exact, exact_camera, torch.ones(1, 1).double()).image
    assert expected.max() > 0.4
    assert float((image - expected).abs().max()) < 2e-4


@pytest.mark.parametrize("backend", ["torch"], indirect=True)
def test_the_size_of_a_chunk_changes_nothing(monkeypatch):
    cloud = make_cloud(500, 60, 40, size=0.15)
    whole = cloud.leaves()
    expected = cloud.render(rasterize, whole)
    expected_gradients = gradients(expected, whole)
    monkeypatch.setattr(torch_rasterizer, "ROWS_AT_A_TIME", 300)
    monkeypatch.setattr(torch_rasterizer, "DEPTH", 5)
    monkeypatch.setattr(torch_rasterizer, "TILES", {"cpu": 3})
    leaves = cloud.leaves()
    rendering = cloud.render(rasterize, leaves)
    torch.testing.assert_close(rendering.image, expected.image, atol=1e-12, rtol=0)
    for name, value in gradients(rendering, leaves).items():
        assert relative_error(value, expected_gradients[name]) < 1e-11, name


@pytest.mark.parametrize("backend", ["torch"], indirect=True)
def test_gaussians_close_to_the_camera_do_not_blow_up_the_memory(monkeypatch):
    make_rows, made = torch_rasterizer._rows, []
    composite, pixels = torch_rasterizer._composite, []

    def counting(boxes, *rest):
        made.append(int((boxes[:, 2:] - boxes[:, :2] + 1).prod(1).sum()))
        return make_rows(boxes, *rest)

    def measuring(rows, *rest):
        pixels.append(rows[..., 0].numel() * torch_rasterizer.TILE**2)
        return composite(rows, *rest)

    monkeypatch.setattr(torch_rasterizer, "_rows", counting)
    monkeypatch.setattr(torch_rasterizer, "_composite", measuring)
    cloud = make_cloud(3000, 320, 240, size=0.02)
    cloud.tensors["means"] *= 0.02
    cloud.tensors["view_matrix"][:3, 3] *= 0.02
    leaves = cloud.leaves(torch.float32)
    cloud.render(rasterize, leaves).image.sum().backward()
    assert len(made) > 2
    assert max(made) <= torch_rasterizer.ROWS_AT_A_TIME
    assert max(pixels) <= 64 * 32 * torch_rasterizer.TILE**2
    assert bool(leaves["means"].grad.isfinite().all())


def test_no_pair_of_tile_and_gaussian_that_reaches_the_threshold_is_culled():
    cloud = make_cloud(300, 70, 50, size=0.06)
    leaves = cloud.leaves()
    parts = gaussians(leaves), cloud.camera(leaves), torch.eye(300, dtype=torch.float64)
    single, alone = rasterize(*parts), rasterize_reference(*parts)
    assert bool(((alone.image > 0) == (single.image > 0)).all())


def test_sizes_that_do_not_fit_are_reported_with_both_numbers():
    cloud = make_cloud(5, 8, 8)
    leaves = cloud.leaves()
    with pytest.raises(ValueError, match=r"there are 5 means, but \{'channels': 4\}"):
        cloud.render(rasterize, leaves | {"channels": leaves["channels"][:4]})
    with pytest.raises(ValueError, match=r"5 channels, but a background of shape \(2,\)"):
        rasterize(gaussians(leaves), cloud.camera(leaves), leaves["channels"], torch.zeros(2))
