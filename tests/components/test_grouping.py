"""Sharpening by groups: sums are kept, what is alike draws together, and nothing else matters."""

import pytest
import torch

from lang3dxl_ns.training import sharpening
from lang3dxl_ns.training.sharpening import sharpen


def scene(count=3000, seed=0, kinds=4):
    """Blurred features of some materials whose dense features, of 6 channels, tell them apart; float64."""
    generator = torch.Generator().manual_seed(seed)
    kind = torch.randint(kinds, (count,), generator=generator)
    truth = torch.randn(kinds, 5, generator=generator, dtype=torch.float64)
    blur = torch.rand(count, 1, generator=generator, dtype=torch.float64) * 0.8
    other = truth[torch.randint(kinds, (count,), generator=generator)]
    centers = 10 * torch.randn(kinds, 6, generator=generator, dtype=torch.float64)
    dense = centers[kind] + 0.1 * torch.randn(count, 6, generator=generator, dtype=torch.float64)
    mass = torch.rand(count, generator=generator, dtype=torch.float64) * 9
    mass[::7] = 0
    return truth[kind].lerp(other, blur), dense, mass, truth[kind]


def test_the_sum_over_all_pixels_is_kept():
    features, dense, mass, _ = scene()
    before, after = mass @ features, mass @ sharpen(features, dense, mass)
    torch.testing.assert_close(after, before, rtol=1e-12, atol=1e-9)


def test_what_crops_blurred_comes_closer_to_the_truth():
    features, dense, mass, truth = scene()
    seen = mass > 0

    def error(values):
        return (values - truth)[seen].square().mean().sqrt()

    assert error(sharpen(features, dense, mass)) < 0.75 * error(features)


def test_a_scene_of_one_feature_stays_as_it_is():
    _, dense, mass, _ = scene()
    features = torch.ones(len(mass), 5, dtype=torch.float64) * torch.arange(5)
    torch.testing.assert_close(sharpen(features, dense, mass), features, rtol=0, atol=1e-12)


def test_gaussians_that_no_photo_sees_neither_move_nor_count():
    features, dense, mass, _ = scene()
    unseen = mass == 0
    after = sharpen(features, dense, mass)
    assert torch.equal(after[unseen], features[unseen])
    nothing = torch.zeros_like(mass)
    assert torch.equal(sharpen(features, dense, nothing), features)
    features[unseen], dense[unseen] = torch.nan, torch.nan
    assert torch.equal(sharpen(features, dense, mass)[~unseen], after[~unseen])


def test_the_axes_of_dense_features_do_not_matter():
    features, dense, mass, _ = scene()
    turn, _ = torch.linalg.qr(torch.randn(6, 6, generator=torch.Generator().manual_seed(1)).double())
    expected = sharpen(features, dense, mass)
    torch.testing.assert_close(sharpen(features, dense @ turn, mass), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 127, 128, 129])
def test_few_gaussians(count):
    features, dense, mass, _ = scene(count)
    mass[0] = 1
    after = sharpen(features.float(), dense.float(), mass.float())
    assert after.shape == features.shape and after.isfinite().all()


def test_how_many_are_read_at_a_time_does_not_matter(monkeypatch):
    features, dense, mass, _ = scene()
    expected = sharpen(features, dense, mass)
    monkeypatch.setattr(sharpening, "_ROWS", 17)
    torch.testing.assert_close(sharpen(features, dense, mass), expected, rtol=0, atol=1e-12)


def test_groups_found_from_a_sample_do_for_all(monkeypatch):
    features, dense, mass, truth = scene()
    monkeypatch.setattr(sharpening, "_SAMPLE", 500)
    seen, after = mass > 0, sharpen(features, dense, mass)
    assert (after - truth)[seen].square().mean() < 0.6 * (features - truth)[seen].square().mean()
