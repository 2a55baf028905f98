"""Splats and their rendering: laws of frames, selections and threads."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from moved_splats import transformed, with_colors
from scipy.spatial.transform import Rotation

from lang3dxl_ns.rendering import Splats, rasterize, render
from lang3dxl_ns.scene.camera import Camera


def cloud(degree: int = 3, count: int = 60) -> Splats:
    generator = torch.Generator().manual_seed(1)

    def rand(*shape):
        return torch.rand(count, *shape, generator=generator)

    harmonics = rand((degree + 1) ** 2, 3) - 0.5
    return Splats(rand(3) - 0.5, rand(4) - 0.5, 0.05 + 0.1 * rand(3), rand(), harmonics)


def camera(view: torch.Tensor | None = None) -> Camera:
    if view is None:
        view = torch.eye(4)
        view[2, 3] = 2.0
    return Camera(view, torch.tensor([[60.0, 0, 24], [0, 55.0, 16], [0, 0, 1]]), 48, 32)


def similarity() -> torch.Tensor:
    matrix = torch.eye(4)
    matrix[:3, :3] = 2.5 * torch.from_numpy(Rotation.from_euler("xyz", [0.3, -1.1, 2.0]).as_matrix())
    matrix[:3, 3] = torch.tensor([3.0, -1.0, 0.5])
    return matrix


def moved(camera: Camera, matrix: torch.Tensor) -> Camera:
    """The camera that sees the transformed world as this one sees the world."""
    scale = float(matrix[:3, :3].det() ** (1 / 3))
    view = camera.view_matrix @ matrix.inverse()
    view[:3] *= scale  # rigid again: depths grow by the scale
    return Camera(view, camera.intrinsics, camera.width, camera.height)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_scene_looks_the_same_in_every_frame(degree):
    splats, channels = cloud(degree), torch.rand(60, 2)
    here = render(splats, camera(), channels)
    there = render(transformed(splats, similarity()), moved(camera(), similarity()), channels)
    torch.testing.assert_close(there.rgb, here.rgb, atol=2e-4, rtol=0)
    torch.testing.assert_close(there.channels, here.channels, atol=2e-4, rtol=0)
    torch.testing.assert_close(there.depth, 2.5 * here.depth, atol=2e-3, rtol=0)


def test_back_and_forth_is_no_change():
    splats = cloud()
    back = transformed(transformed(splats, similarity()), similarity().inverse())
    for name in ("means", "scales", "harmonics"):
        torch.testing.assert_close(getattr(back, name), getattr(splats, name), atol=1e-5, rtol=1e-5)


def test_a_selection_renders_like_the_rest_made_transparent():
    splats, keep = cloud(), torch.arange(60) % 3 == 0
    hidden = Splats(
        splats.means, splats.quats, splats.scales, torch.where(keep, splats.opacities, 0.0), splats.harmonics
    )
    torch.testing.assert_close(
        render(splats.select(keep), camera()).rgb, render(hidden, camera()).rgb, atol=1e-6, rtol=0
    )
    torch.testing.assert_close(splats.select(keep.numpy()).means, splats.means[keep])
    assert len(splats.select(keep.nonzero()[:, 0])) == int(keep.sum())


def test_colors_are_those_that_the_rasterizer_composites():
    splats = cloud()
    position = -camera().view_matrix[:3, :3].T @ camera().view_matrix[:3, 3]
    expected = rasterize(splats.gaussians, camera(), splats.colors(position)).image.clamp(0, 1)
    torch.testing.assert_close(render(splats, camera()).rgb, expected)
    plain = with_colors(splats, splats.colors(position))
    assert plain.degree == 0
    torch.testing.assert_close(render(plain, camera()).rgb, expected, atol=1e-6, rtol=0)


def test_broken_gaussians_are_told():
    splats = cloud()
    splats.scales[3, 1], splats.harmonics[5, 2, 0] = float("nan"), float("inf")
    assert (~splats.sound()).nonzero().flatten().tolist() == [3, 5]


def test_renderings_of_several_threads_are_those_of_one():
    splats, channels = cloud(count=60), torch.rand(60, 5)
    expected = render(splats, camera(), channels)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: render(splats, camera(), channels), range(16)))
    for one in found:
        assert torch.equal(one.rgb, expected.rgb) and torch.equal(one.channels, expected.channels)
