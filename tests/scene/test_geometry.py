"""Frustum culling, and the extent of a scene."""

import pytest
import torch

from lang3dxl_ns.rendering import Gaussians, rasterize
from lang3dxl_ns.scene.camera import Camera, Lens, in_view
from lang3dxl_ns.training.gaussians import center_and_radius


def wide_camera(seed: int) -> Camera:
    generator = torch.Generator().manual_seed(seed)
    view = torch.eye(4)
    view[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=generator))[0]
    view[:3, 3] = torch.randn(3, generator=generator)
    intrinsics = torch.tensor([[30.0, 0.0, 20.0], [0.0, 35.0, 33.0], [0.0, 0.0, 1.0]])
    return Camera(view, intrinsics, width=64, height=48)


@pytest.mark.parametrize("seed", range(4))
def test_no_gaussian_that_shows_is_out_of_view(seed):
    generator = torch.Generator().manual_seed(seed)
    n = 3000
    means = 4 * torch.randn(n, 3, generator=generator)
    scales = torch.randn(n, 3, generator=generator).sub(3).exp()
    quats = torch.randn(n, 4, generator=generator)
    camera = wide_camera(seed)
    seen = in_view(camera, means, scales)
    # Only Gaussians out of view are colored: nothing may show.
    drawn = Gaussians(means, quats, scales, torch.full((n,), 0.9))
    picture = rasterize(drawn, camera, (~seen)[:, None].float()).image
    assert float(picture.abs().max()) == 0
    assert 0.05 < float(seen.float().mean()) < 0.6


def test_radius_holds_nine_tenths_and_grows_with_the_world():
    points = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0))
    center, radius = center_and_radius(points)
    assert float(((points - center).norm(dim=1) < radius).float().mean()) == pytest.approx(0.9, abs=0.01)
    assert center_and_radius(7 * points)[1] == pytest.approx(7 * radius)


def test_a_resized_lens_sees_the_same_directions_at_the_resized_pixels():
    lens = Lens(64, 48, 50.0, 57.0, 30.0, 26.0)
    small = lens.resized(16, 24)
    point = torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64)
    seen, seen_small = lens.matrix @ point, small.matrix @ point
    torch.testing.assert_close(seen_small[:2], seen[:2] * torch.tensor([16 / 64, 24 / 48]))
    assert lens.scaled(0.5) == lens.resized(32, 24)
    assert (lens.scaled(1e-9).width, lens.scaled(1e-9).height) == (1, 1)
