"""Laws of training-free lifting."""

import torch

from lang3dxl_ns.baselines.lifting import LiftedFeatures, lift, pixel_features
from lang3dxl_ns.rendering import Camera, Gaussians, rasterize

SIZE = 24


def gaussians(count: int = 5) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    means[-1] = torch.tensor([0.0, 0.0, -50.0])  # behind every camera
    return Gaussians(
        means,
        torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(count, 1),
        torch.full((count, 3), 0.15, dtype=torch.float64),
        torch.full((count,), 0.7, dtype=torch.float64),
    )


def cameras() -> list[Camera]:
    intrinsics = torch.tensor([[20.0, 0.0, SIZE / 2], [0.0, 20.0, SIZE / 2], [0.0, 0.0, 1.0]])
    views = []
    for x in (-0.3, 0.3):
        view = torch.eye(4, dtype=torch.float64)
        view[:3, 3] = torch.tensor([x, 0.0, 2.0])
        views.append(Camera(view, intrinsics.double(), SIZE, SIZE))
    return views


def composite(camera: Camera, carried: torch.Tensor) -> torch.Tensor:
    scene = gaussians()
    rendering = rasterize(scene, camera, torch.zeros(len(carried), 1).double(), features=carried)
    return rendering.features


def test_a_lifted_feature_is_the_mean_of_the_pixels_weighted_by_the_contribution():
    """Weights by hand: what a Gaussian alone carries a 1 of is its contribution to every pixel."""
    generator = torch.Generator().manual_seed(1)
    pixels = [torch.rand(SIZE, SIZE, 4, generator=generator, dtype=torch.float64) for _ in cameras()]
    for view in pixels:
        view[..., -1] = 1
        view[:, :3] = 0  # masked
    views = [
        (lambda carried, camera=camera: composite(camera, carried), view)
        for camera, view in zip(cameras(), pixels, strict=True)
    ]
    lifted = lift(5, views, 4, torch.zeros(1, dtype=torch.float64))

    expected = torch.zeros(5, 4, dtype=torch.float64)
    for index in range(4):
        total, mass = torch.zeros(4, dtype=torch.float64), 0.0
        for camera, view in zip(cameras(), pixels, strict=True):
            weight = composite(camera, torch.eye(5, dtype=torch.float64)[:, index : index + 1])
            total += (weight * view).sum((0, 1))
            mass += (weight * view[..., -1:]).sum()
        expected[index] = total / mass
    torch.testing.assert_close(lifted, expected)
    assert (lifted[-1] == 0).all()  # never seen


def test_where_all_pixels_agree_the_rendered_feature_is_theirs_at_any_coverage():
    feature = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
    pixels = torch.cat([feature, torch.ones(1).double()]).expand(SIZE, SIZE, 4)
    camera = cameras()[0]
    lifted = lift(5, [(lambda carried: composite(camera, carried), pixels)], 4, feature)
    rendered = composite(camera, lifted)
    clip, dense = LiftedFeatures(2, 1)(rendered)
    seen = rendered[..., -1] > 1e-3
    assert rendered[..., -1][seen].min() < 0.1
    torch.testing.assert_close(clip[seen], feature[:2].expand(int(seen.sum()), 2))
    torch.testing.assert_close(dense[seen], feature[2:].expand(int(seen.sum()), 1))


def test_pixels_have_the_targets_at_their_places_and_nothing_off_the_mask():
    ramp = ((torch.arange(8) + 0.5) / 8).expand(6, 8)[..., None]
    mask = torch.zeros(12, 16, dtype=torch.bool)
    mask[:, 8:] = True
    pixels = pixel_features(ramp, torch.full((3, 3, 2), 5.0), mask, (12, 16))
    assert pixels.shape == (12, 16, 4)
    assert (pixels[:, :8] == 0).all()
    torch.testing.assert_close(pixels[:, 8:15, 0], ((torch.arange(16) + 0.5) / 16)[8:15].expand(12, 7))
    assert (pixels[:, 8:, 1:3] == 5).all() and (pixels[:, 8:, 3] == 1).all()
    everywhere = pixel_features(ramp, None, None, (12, 16))
    assert (everywhere[..., -1] == 1).all() and everywhere.shape == (12, 16, 2)
