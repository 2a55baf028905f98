"""Laws of gathering pixels onto Gaussians."""

from functools import partial

import pytest
import torch

from lab.baselines.lifting import LiftedFeatures
from lang3dxl_ns.components.feature_decoder import Gathered
from lang3dxl_ns.rendering import Gaussians, gathering, rasterize
from lang3dxl_ns.rendering.gathering import Pixels, filled_pixels, gather
from lang3dxl_ns.scene.camera import Camera

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


def whole(values: torch.Tensor) -> Pixels:
    """Of values at every pixel, whose last channel tells where they are known; all is foreground."""
    return Pixels([values[..., :-1]], values[..., -1], torch.zeros_like(values[..., -1]))


def composite(camera: Camera, carried: torch.Tensor) -> torch.Tensor:
    scene = gaussians()
    return rasterize(scene, camera, carried).image


def test_the_memory_to_work_in_changes_nothing(monkeypatch):
    """Channels are gathered a few at a time where memory is short, and the result moves to the CPU."""
    generator = torch.Generator().manual_seed(2)
    views = [
        (
            lambda carried, camera=camera: composite(camera, carried),
            Pixels.of(
                [torch.rand(SIZE, SIZE, k, generator=generator, dtype=torch.float64) for k in (2, 5)],
                (SIZE, SIZE),
            ),
        )
        for camera in cameras()
    ]
    like = torch.zeros(1, dtype=torch.float64)
    expected = gather(5, views, 7, like)
    widths = []

    def watched(carried, work):
        widths.append(carried.shape[1])
        return work(carried)

    watching = [(partial(watched, work=work), pixels) for work, pixels in views]
    numbers = 2 * (5 + SIZE * SIZE)
    monkeypatch.setattr(gathering, "MEMORY", 4 * 4 * numbers)
    found = gather(5, watching, 7, like)
    assert widths == [4, 4, 1] * len(views)
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other)


def test_where_all_pixels_agree_the_rendered_feature_is_theirs_at_any_coverage():
    feature = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
    pixels = torch.cat([feature, torch.ones(1).double()]).expand(SIZE, SIZE, 4)
    camera = cameras()[0]
    decoder = LiftedFeatures(2, 1)
    lifted = gather(5, [(lambda carried: composite(camera, carried), whole(pixels))], 3, feature)
    rendered = composite(camera, decoder.learn_gaussians(Gathered(*lifted)))
    clip, dense = decoder(rendered)
    seen = rendered[..., -1] > 1e-3
    assert rendered[..., -1][seen].min() < 0.1
    torch.testing.assert_close(clip[seen], feature[:2].expand(int(seen.sum()), 2))
    torch.testing.assert_close(dense[seen], feature[2:].expand(int(seen.sum()), 1))


def test_pixels_have_the_targets_at_their_places_and_nothing_off_the_mask():
    ramp = ((torch.arange(8) + 0.5) / 8).expand(6, 8)[..., None]
    mask = torch.zeros(12, 16, dtype=torch.bool)
    mask[:, 8:] = True
    pixels = Pixels.of([ramp, torch.full((3, 3, 2), 5.0)], (12, 16), mask).channels(0, 9)
    assert pixels.shape == (12, 16, 5)
    assert (pixels[:, :8, :4] == 0).all() and torch.equal(pixels[..., 4] == 1, ~mask)
    torch.testing.assert_close(pixels[:, 8:15, 0], ((torch.arange(16) + 0.5) / 16)[8:15].expand(12, 7))
    assert (pixels[:, 8:, 1:3] == 5).all() and (pixels[:, 8:, 3] == 1).all()
    everywhere = Pixels.of([ramp], (12, 16)).channels(0, 9)
    assert (everywhere[..., 1] == 1).all() and everywhere.shape == (12, 16, 3)


@pytest.mark.parametrize("step", [1, 2, 3, 5])
def test_channels_a_few_at_a_time_are_all_channels(step):
    draw = torch.Generator().manual_seed(5)
    maps = [torch.rand(4, 5, 3, generator=draw), torch.rand(6, 6, 2, generator=draw)]
    pixels = Pixels.of(maps, (9, 11), torch.rand(9, 11, generator=draw) > 0.3)
    parts = [pixels.channels(first, first + step) for first in range(0, 7, step)]
    torch.testing.assert_close(torch.cat(parts, dim=-1), pixels.channels(0, 7), rtol=0, atol=0)


def test_the_order_of_photos_does_not_matter_and_a_photo_that_counts_nowhere_adds_nothing():
    generator = torch.Generator().manual_seed(2)
    pixels = [torch.rand(SIZE, SIZE, 4, generator=generator, dtype=torch.float64) for _ in range(2)]
    for view in pixels:
        view[..., -1] = 1
    views = [
        (lambda carried, camera=camera: composite(camera, carried), whole(view))
        for camera, view in zip(cameras(), pixels, strict=True)
    ]
    nothing = (views[0][0], whole(torch.zeros(SIZE, SIZE, 4).double()))
    there = gather(5, views, 3, torch.zeros(1, dtype=torch.float64))
    back = gather(5, [*views[::-1], nothing], 3, torch.zeros(1, dtype=torch.float64))
    torch.testing.assert_close(there[0], back[0])
    torch.testing.assert_close(there[1], back[1])


def test_pixels_that_are_not_finite_do_not_count():
    target = torch.ones(4, 4, 2)
    target[0, 0, 1] = torch.nan
    pixels = Pixels.of([target], (4, 4)).channels(0, 3)
    assert pixels.isfinite().all() and (pixels[0, 0] == 0).all() and pixels[..., 2].sum() == 15


def test_what_is_mostly_outside_the_foreground_takes_nothing_from_its_edge():
    """The sky behind a tower is no tower; and a pixel without features is not outside of the foreground."""
    weights = torch.tensor([[[1.0, 0.4]], [[0.0, 0.6]]])  # two pixels, one above the other, two Gaussians
    mask = torch.tensor([[True], [False]])

    def gathered(*pixels):
        return gather(2, [(lambda carried: weights @ carried, each) for each in pixels], 1, weights)

    features, mass = gathered(Pixels.of([torch.full((2, 1, 1), 3.0)], (2, 1), mask))
    assert features[:, 0].tolist() == [3.0, 0.0] and mass.tolist() == [1.0, 0.0]
    other = Pixels.of([torch.full((2, 1, 1), 3.0)], (2, 1), ~mask)  # a photo that has it in its foreground
    assert gathered(Pixels.of([torch.full((2, 1, 1), 3.0)], (2, 1), mask), other)[1][1] == 1.0
    torn = torch.tensor([[[3.0]], [[torch.nan]]])
    assert gathered(Pixels.of([torn], (2, 1)))[1].tolist() == pytest.approx([1.0, 0.4])


def test_pixels_that_a_gaussian_fills_are_its_weights():
    camera = cameras()[0]
    weight = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    filled = filled_pixels(lambda carried: composite(camera, carried), weight, 5)
    for index in range(5):
        alone = torch.zeros(5, 1, dtype=torch.float64)
        alone[index] = 1
        expected = (composite(camera, alone)[..., 0] * weight).sum()
        torch.testing.assert_close(filled[index], expected)
