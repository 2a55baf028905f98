"""The gsplat backend: on a GPU against the torch backend; elsewhere the arguments passed and returned."""

import pytest
import torch
from splat_clouds import gradients, make_cloud, maps, relative_error

from lang3dxl_ns.rendering import Gaussians, rasterize
from lang3dxl_ns.rendering.gaussians import ALPHA_MIN
from lang3dxl_ns.scene.camera import Camera

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def stand_in(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **settings):
    """gsplat.rasterization's signature over the torch backend: one camera, float32, unpacked."""
    assert settings.pop("packed") is False
    assert {tensor.dtype for tensor in (means, quats, scales, opacities, colors, viewmats, Ks)} == {
        torch.float32
    }
    depth = settings.pop("render_mode", "RGB") == "RGB+D"
    rendering = rasterize(
        Gaussians(means, quats, scales, opacities), Camera(viewmats[0], Ks[0], width, height), colors,
        near=settings.pop("near_plane"), eps2d=settings.pop("eps2d"),
        antialiased=settings.pop("rasterize_mode") == "antialiased", render_depth=depth,
        backend="torch",
    )  # fmt: skip
    assert not settings
    image = rendering.image
    if depth:  # accumulated
        image = torch.cat([image, rendering.depth * rendering.alpha.clamp_min(ALPHA_MIN / 2)], dim=2)
    return image[None], rendering.alpha[None], {**rendering.info, "tile_size": 16}


@pytest.mark.parametrize("depth", [True, False])
def test_the_maps_and_gradients_come_back_in_their_places(monkeypatch, depth):
    monkeypatch.setattr("gsplat.rasterization", stand_in)
    cloud = make_cloud(200, 40, 30)
    settings = {"render_depth": depth, "antialiased": True, "near": 1.0}
    torch_leaves, gsplat_leaves = cloud.leaves(torch.float32), cloud.leaves(torch.float32)
    expected = cloud.render(rasterize, torch_leaves, backend="torch", **settings)
    found = cloud.render(rasterize, gsplat_leaves, backend="gsplat", **settings)
    assert maps(found).keys() == maps(expected).keys()
    for name, value in maps(expected).items():
        torch.testing.assert_close(getattr(found, name), value, atol=1e-6, rtol=1e-5)
    expected_gradients = gradients(expected, torch_leaves)
    for name, value in gradients(found, gsplat_leaves).items():
        assert relative_error(value, expected_gradients[name]) < 1e-4, name
    assert found.info.keys() == expected.info.keys()


def test_tensors_on_the_cpu_are_rendered_by_torch(monkeypatch):
    monkeypatch.setattr("gsplat.rasterization", lambda *a, **k: pytest.fail("gsplat was called"))
    cloud = make_cloud(20, 16, 16)
    cloud.render(rasterize, cloud.leaves(torch.float32))


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("antialiased", [True, False])
def test_both_backends_render_the_same_function(antialiased):
    cloud = make_cloud(3000, 160, 120, size=0.03)
    cloud.tensors = {name: value.cuda() for name, value in cloud.tensors.items()}
    cloud.intrinsics = cloud.intrinsics.cuda()
    renderings, found = {}, {}
    for backend in ("torch", "gsplat"):
        leaves = cloud.leaves(torch.float32)
        rendering = renderings[backend] = cloud.render(
            rasterize, leaves, backend=backend, antialiased=antialiased
        )
        rendering.info["means2d"].retain_grad()
        found[backend] = gradients(rendering, leaves)
    # gsplat cuts at three standard deviations, rounded out to tiles of 16; the torch backend where alpha
    # reaches 1/255, so that an opaque Gaussian's rim (alpha below 0.011) may be missing there.
    for name, value in maps(renderings["torch"]).items():
        error = (getattr(renderings["gsplat"], name) - value).abs()
        assert error.mean() < 2e-3, name
        assert (error > 2e-2).float().mean() < 1e-2, name
    for name, value in found["torch"].items():
        assert relative_error(found["gsplat"][name], value) < 5e-2, name
    radii = [rendering.info["radii"].float() for rendering in renderings.values()]
    assert ((radii[0] - radii[1]).abs() > 1).float().mean() < 1e-3


@pytest.mark.cuda
@needs_gpu
def test_the_torch_backend_gives_the_same_on_a_gpu_as_on_the_cpu():
    cloud = make_cloud(500, 60, 40)
    on_cpu = cloud.render(rasterize, cloud.leaves())
    cloud.tensors = {name: value.cuda() for name, value in cloud.tensors.items()}
    cloud.intrinsics = cloud.intrinsics.cuda()
    on_gpu = cloud.render(rasterize, cloud.leaves(), backend="torch")
    for name, value in maps(on_cpu).items():
        torch.testing.assert_close(getattr(on_gpu, name).cpu(), value, atol=1e-9, rtol=0)


def test_gaussians_without_rotation_are_drawn_unrotated(monkeypatch):
    """gsplat's kernels divide by the length of a quaternion."""

    def of_unit_length(*arguments, **named):
        assert (named["quats"].norm(dim=1) > 0).all()
        return stand_in(*arguments, **named)

    monkeypatch.setattr("gsplat.rasterization", of_unit_length)
    n, camera = 20, Camera(torch.eye(4), torch.tensor([[30.0, 0, 20], [0, 30.0, 15], [0, 0, 1]]), 40, 30)
    draw = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=draw) + torch.tensor([-0.5, -0.5, 2.0])
    scales, half = 0.1 * torch.rand(n, 3, generator=draw), torch.full((n,), 0.5)
    drawn = [
        rasterize(Gaussians(means, quats, scales, half), camera, torch.ones(n, 3), backend="gsplat").image
        for quats in (torch.zeros(n, 4), torch.eye(4)[:1].expand(n, 4))
    ]
    assert drawn[0].any()
    torch.testing.assert_close(drawn[0], drawn[1])
