"""Laws of the losses."""

import pytest
import torch
import torch.nn.functional as F
from pytorch_msssim import SSIM

from lang3dxl_ns.common.image import resize
from lang3dxl_ns.components.losses import clip_loss, dense_loss, region_variance_loss, rgb_loss


def seeded(*size, seed=0, dtype=torch.float64):
    return torch.rand(*size, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def labels_of(*size, count, seed=0):
    return torch.randint(-1, count, size, generator=torch.Generator().manual_seed(seed))


def ssim_by_definition(a, b):
    """Wang et al. 2004 over all whole windows, in float64."""
    distance = torch.arange(11, dtype=torch.float64) - 5
    gauss = torch.exp(-(distance**2) / (2 * 1.5**2))
    window = torch.outer(gauss, gauss)[None, None] / gauss.sum() ** 2

    def mean(x):
        return F.conv2d(x.permute(2, 0, 1)[:, None], window)

    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b, cov = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2, mean(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    quality = (2 * mean_a * mean_b + c1) * (2 * cov + c2)
    return (quality / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))).mean()


# ------------------------------------------------------------------ colors


@pytest.mark.parametrize("weight", [0.0, 0.2, 0.5])
def test_rgb_loss_is_the_usual_mix_of_l1_and_ssim(weight):
    a, b = seeded(20, 30, 3), seeded(20, 30, 3, seed=1)
    l1 = (a - b).abs().mean()
    by_definition = (1 - weight) * l1 + weight * (1 - ssim_by_definition(a, b))
    torch.testing.assert_close(rgb_loss(a, b, ssim_weight=weight), by_definition)
    planes = a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None]
    usual = (1 - weight) * l1 + weight * (1 - SSIM(data_range=1.0, size_average=True, channel=3)(*planes))
    torch.testing.assert_close(rgb_loss(a, b, ssim_weight=weight), usual, rtol=1e-5, atol=1e-6)


def test_a_full_mask_changes_no_loss():
    a, b, mask = seeded(20, 30, 3), seeded(20, 30, 3, seed=1), torch.ones(20, 30, dtype=torch.bool)
    torch.testing.assert_close(rgb_loss(a, b, mask), rgb_loss(a, b))


def test_masked_l1_is_the_mean_over_the_mask_however_small_it_is():
    prediction, target, mask = torch.zeros(20, 30, 3), torch.zeros(20, 30, 3), torch.zeros(20, 30)
    mask[:4, :5] = 1
    target[:4, :5], target[4:] = 0.25, 0.9
    assert rgb_loss(prediction, target, mask, ssim_weight=0).item() == pytest.approx(0.25)
    torch.testing.assert_close(
        rgb_loss(prediction, target, mask * 0.5), rgb_loss(prediction, target, mask), rtol=1e-6, atol=0
    )


def test_ssim_sees_the_whole_image():
    prediction, mask = seeded(40, 40, 3), torch.zeros(40, 40, dtype=torch.bool)
    mask[:20] = True
    target = prediction.clone()
    target[30:] = seeded(10, 40, 3, seed=1)
    assert rgb_loss(prediction, target, mask).item() > 0.01


@pytest.mark.parametrize("size", [(1, 1), (1, 30), (10, 4), (11, 10), (3, 200)])
def test_images_below_the_ssim_window_have_a_finite_loss_and_gradient(size):
    a, b = seeded(*size, 3).requires_grad_(), seeded(*size, 3, seed=1)
    loss = rgb_loss(a, b)
    loss.backward()
    assert 0 < loss.item() < 2
    assert a.grad.isfinite().all()
    assert rgb_loss(b, b).item() == pytest.approx(0, abs=1e-7)


# ------------------------------------------------------------------ empty masks


@pytest.mark.parametrize(
    "loss",
    [
        lambda x: rgb_loss(x, torch.ones_like(x), torch.zeros(12, 14)),
        lambda x: clip_loss(x, torch.ones_like(x), torch.zeros(12, 14)),
        lambda x: region_variance_loss(x, torch.zeros(12, 14, dtype=torch.long), torch.zeros(12, 14)),
        lambda x: region_variance_loss(x, torch.full((12, 14), -1)),
    ],
)
def test_an_empty_mask_gives_zero_with_zero_gradient(loss):
    x = seeded(12, 14, 3, dtype=torch.float32).requires_grad_()
    value = loss(x)
    value.backward()
    assert value.item() == 0
    assert value.shape == ()
    assert (x.grad == 0).all()


# ------------------------------------------------------------------ features


def test_clip_loss_is_a_weighted_mean_over_cells_and_channels():
    a, b, weight = seeded(4, 5, 6), seeded(4, 5, 6, seed=1), seeded(4, 5, seed=2)
    torch.testing.assert_close(clip_loss(a, b), F.l1_loss(a, b))
    by_cell = (a - b).abs().mean(-1)
    torch.testing.assert_close(clip_loss(a, b, weight), (by_cell * weight).sum() / weight.sum())
    torch.testing.assert_close(clip_loss(a, b, 7 * weight), clip_loss(a, b, weight))
    mask = weight > 0.5
    torch.testing.assert_close(clip_loss(a, b, mask), by_cell[mask].mean())


@pytest.mark.parametrize(("size", "grid"), [((12, 16), (24, 24)), ((20, 30), (9, 9)), ((7, 9), (7, 9))])
def test_dense_loss_keeps_positions_within_a_tenth_of_a_cell_on_any_two_grids(size, grid):
    """A wave that is flat at the border has there what a resize extends it by."""

    def wave(n, m):
        return torch.cos(torch.pi * (torch.arange(m, dtype=torch.float64) + 0.5) / m).expand(n, m)[..., None]

    mean_slope, cell = 2, 1 / min(size[1], grid[1])
    assert dense_loss(wave(*size), wave(*grid)).item() < 0.1 * cell * mean_slope
    shifted = dense_loss(wave(*size) + 2, wave(*grid))
    assert shifted.item() == pytest.approx(2, abs=1e-6)


def test_dense_loss_is_the_published_resize_for_a_finer_target():
    prediction, target = seeded(9, 12, 4), seeded(16, 16, 4, seed=1)
    resized = F.interpolate(prediction.permute(2, 0, 1)[None], (16, 16), mode="bilinear", align_corners=False)
    expected = F.l1_loss(resized[0].permute(1, 2, 0), target)
    torch.testing.assert_close(dense_loss(prediction, target), expected)


def test_dense_loss_averages_a_finer_prediction():
    prediction, target = seeded(16, 16, 2), seeded(4, 4, 2, seed=1)
    checkered = prediction + (torch.arange(16)[:, None, None] % 2 - 0.5)
    inner = slice(1, -1)  # at the border an average has fewer rows
    resized = [resize(values, (4, 4))[inner] for values in (prediction, checkered)]
    torch.testing.assert_close(*resized)
    expected = (resize(prediction, (4, 4)) - target).abs().mean()
    torch.testing.assert_close(dense_loss(prediction, target), expected)


# ------------------------------------------------------------------ regions


def region_variance_by_loops(features, labels, mask=None):
    valid = labels >= 0 if mask is None else (labels >= 0) & mask
    total = features.new_zeros(())
    for label in set(labels[valid].tolist()):
        pixels = features[valid & (labels == label)]
        total = total + ((pixels - pixels.mean(0)) ** 2).sum()
    return total / valid.sum()


@pytest.mark.parametrize("masked", [False, True])
def test_region_variance_equals_a_loop_over_regions_in_value_and_gradient(masked):
    labels = labels_of(15, 17, count=6)
    mask = seeded(15, 17, seed=3) > 0.4 if masked else None
    results = []
    for loss in (region_variance_loss, region_variance_by_loops):
        features = seeded(15, 17, 5).requires_grad_()
        value = loss(features, labels, mask)
        results.append((value.detach(), *torch.autograd.grad(value, features)))
    torch.testing.assert_close(*results)


def test_region_variance_of_maps_that_are_constant_in_each_region_is_zero():
    labels = labels_of(15, 17, count=6)
    features = seeded(7, 5)[labels]
    assert region_variance_loss(features, labels).item() < 1e-25


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
def test_region_variance_does_not_depend_on_the_labels_names(dtype):
    features, labels = seeded(15, 17, 5), labels_of(15, 17, count=6)
    names = torch.tensor([3, 2_000_000_000, 0, 77, 1, 123_456_789, -7], dtype=dtype)  # the last one is for −1
    torch.testing.assert_close(
        region_variance_loss(features, names[labels]), region_variance_loss(features, labels)
    )


def test_region_variance_survives_cancellation_in_float32():
    labels = labels_of(60, 70, count=5)
    features = (1e4 + 1e-3 * (2 * (seeded(60, 70, 8) > 0.5) - 1)).float()
    expected = region_variance_by_loops(features.double(), labels)
    torch.testing.assert_close(region_variance_loss(features, labels).double(), expected, rtol=1e-3, atol=0)


def test_losses_keep_the_type_of_the_prediction():
    for dtype in (torch.float32, torch.float64):
        a, b = seeded(12, 14, 3, dtype=dtype), seeded(12, 14, 3, seed=1, dtype=dtype)
        mask = torch.ones(12, 14, dtype=torch.bool)
        losses = [rgb_loss(a, b, mask), clip_loss(a, b, mask), dense_loss(a, b)]
        losses.append(region_variance_loss(a, mask.long(), mask))
        assert {loss.dtype for loss in losses} == {dtype}
