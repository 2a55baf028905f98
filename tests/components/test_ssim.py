"""The compiled SSIM against pytorch-msssim's."""

import pytest
import torch
from pytorch_msssim import ssim as ssim_reference

from lang3dxl_ns.components.losses import rgb_loss
from lang3dxl_ns.components.ssim import ssim


def images(height, width, dtype, spread=0.2):
    """A smooth image and one that differs from it."""
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 5, 6, generator=generator, dtype=torch.float64)
    target = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")[0]
    noise = torch.randn(target.shape, generator=generator, dtype=torch.float64)
    return (target + spread * noise).clamp(0, 1).to(dtype).requires_grad_(), target.to(dtype)


@pytest.mark.parametrize(("height", "width"), [(11, 11), (12, 40), (37, 26), (48, 64)])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("threads", [1, 3])
def test_value_and_gradient_are_those_of_the_reference(height, width, dtype, bound, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        prediction, target = images(height, width, dtype)
        exact, exact_target = images(height, width, torch.float64)
        window = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
        window = (window / window.sum()).expand(3, 1, 1, 11)  # its own is in float32
        expected = ssim_reference(exact[None], exact_target[None], data_range=1.0, win=window)
        found = ssim(prediction, target)
        assert abs(float(found.detach()) - float(expected.detach())) < bound
        (gradient,) = torch.autograd.grad(3 * found, prediction)
        (expected_gradient,) = torch.autograd.grad(3 * expected, exact)
        error = (gradient - expected_gradient).norm() / expected_gradient.norm()
        assert float(error) < 10 * bound
    finally:
        torch.set_num_threads(before)


def test_the_loss_is_the_same_with_and_without_compiled_kernels(monkeypatch):
    prediction, target = images(30, 45, torch.float32)
    losses = []
    for kernels in ("torch", "numba"):
        monkeypatch.setenv("LANG3DXL_CPU_KERNELS", kernels)
        losses.append(rgb_loss(prediction.permute(1, 2, 0), target.permute(1, 2, 0)))
    torch.testing.assert_close(losses[0], losses[1], rtol=1e-5, atol=1e-6)
    first, second = (torch.autograd.grad(loss, prediction)[0] for loss in losses)
    assert (first - second).norm() < 1e-4 * first.norm()
