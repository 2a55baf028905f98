"""Laws of the losses; values and gradients of hard cases are compared in `lab/numerics/losses.py`."""

import pytest
import torch
from pytorch_msssim import SSIM

from lang3dxl_ns.components.losses import clip_loss, dense_loss, region_variance_loss, rgb_loss


def seeded(*size, seed=0, dtype=torch.float64):
    return torch.rand(*size, dtype=dtype, generator=torch.Generator().manual_seed(seed))


# ------------------------------------------------------------------ colors


@pytest.mark.parametrize("weight", [0.0, 0.2, 0.5])
def test_rgb_loss_is_the_usual_mix_of_l1_and_ssim(weight):
    a, b = seeded(20, 30, 3), seeded(20, 30, 3, seed=1)
    l1 = (a - b).abs().mean()
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


# ------------------------------------------------------------------ features


@pytest.mark.parametrize(("size", "grid"), [((12, 16), (24, 24)), ((20, 30), (9, 9)), ((7, 9), (7, 9))])
def test_dense_loss_keeps_positions_within_a_tenth_of_a_cell_on_any_two_grids(size, grid):
    """A wave that is flat at the border has there what a resize extends it by."""

    def wave(n, m):
        return torch.cos(torch.pi * (torch.arange(m, dtype=torch.float64) + 0.5) / m).expand(n, m)[..., None]

    mean_slope, cell = 2, 1 / min(size[1], grid[1])
    assert dense_loss(wave(*size), wave(*grid)).item() < 0.1 * cell * mean_slope
    shifted = dense_loss(wave(*size) + 2, wave(*grid))
    assert shifted.item() == pytest.approx(2, abs=1e-6)


def test_losses_keep_the_type_of_the_prediction():
    for dtype in (torch.float32, torch.float64):
        a, b = seeded(12, 14, 3, dtype=dtype), seeded(12, 14, 3, seed=1, dtype=dtype)
        mask = torch.ones(12, 14, dtype=torch.bool)
        losses = [rgb_loss(a, b, mask), clip_loss(a, b, mask), dense_loss(a, b)]
        losses.append(region_variance_loss(a, mask.long(), mask))
        assert {loss.dtype for loss in losses} == {dtype}
