"""Losses of a training step: pure functions that return a scalar.

Every mean but the dense loss's is over the mask, not the image, so that a small building weighs as much as a
large one. An empty mask gives zero with zero gradient.
"""

from __future__ import annotations

import functools

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from pytorch_msssim import ssim
from torch import Tensor

from lang3dxl_ns.common.device import in_full_precision, to_device
from lang3dxl_ns.common.image import resize
from lang3dxl_ns.common.kernels import takes_kernels

_SSIM_WINDOW = 11


@in_full_precision
def rgb_loss(
    prediction: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | None = None,
    ssim_weight: float = 0.5,
) -> Float[Tensor, ""]:
    """Compute (1 − w)·L1 + w·(1 − SSIM) of colors in [0, 1]; SSIM's window is 11 pixels with σ 1.5. L1 is a
    mean over the mask. SSIM sees the whole images, as in the published system. An image narrower than the
    window is extended by its border."""
    color = _weighted_mean((prediction - target).abs(), mask)
    structure = 1 - _ssim(prediction, target)
    if mask is not None:
        structure = torch.where(mask.any(), structure, 0.0)
    return torch.lerp(color, structure, ssim_weight)


@in_full_precision
def clip_loss(
    prediction: Float[Tensor, "hd wd c"],
    target: Float[Tensor, "hd wd c"],
    weight: Bool[Tensor, "hd wd"] | Float[Tensor, "hd wd"] | None = None,
) -> Float[Tensor, ""]:
    """Compute the mean absolute difference of downsampled features and the CLIP target, not normalized."""
    return _weighted_mean((prediction - target).abs(), weight)


@in_full_precision
def dense_loss(prediction: Float[Tensor, "h w d"], target: Float[Tensor, "hd wd d"]) -> Float[Tensor, ""]:
    """Compute the mean absolute difference between decoded dense features, resized to their target's grid,
    and the target. As in the published system, it has no mask. The resize is bilinear and antialiased: it
    averages when shrinking, and keeps positions within a tenth of a cell."""
    return (resize(prediction, (target.shape[0], target.shape[1])) - target).abs().mean()


@in_full_precision
def region_variance_loss(
    features: Float[Tensor, "h w c"],
    labels: Int[Tensor, "h w"],
    mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | None = None,
) -> Float[Tensor, ""]:
    """Compute the variance of features inside regions, summed over channels and averaged over valid pixels.
    It is Σ_r Σ_{i∈r} ‖f_i − mean_r‖² / (number of valid pixels). Labels are any integers, negative for no
    region; the mask is thresholded at 0.5. A region of one pixel only adds to the pixel count."""
    valid = labels >= 0 if mask is None else (labels >= 0) & (mask >= 0.5)
    features, valid = features.flatten(0, 1), valid.flatten()
    rough, rest = _region_means(features, torch.where(valid, labels.flatten(), -1))
    deviations = features - rough - rest
    squares = deviations.square().sum(dim=-1)
    return torch.where(valid, squares, 0.0).sum() / valid.sum().clamp(min=1)


@torch.no_grad()
def _region_means(
    features: Float[Tensor, "n c"], labels: Int[Tensor, " n"]
) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n c"]]:
    """Compute the mean of each pixel's region, as a rounded value and its rounding error, to be subtracted
    one after the other where features are large compared with their spread. They carry no gradient. The loss
    above is still exact, because the deviations in a region sum to zero, and so does the gradient through its
    mean."""
    # Regions are numbered without reading how many there are, which would synchronize a GPU.
    order = labels.argsort()
    ranked = labels[order]
    first = F.pad((ranked[1:] != ranked[:-1]).long(), (1, 0))
    inverse = torch.empty_like(order).scatter_(0, order, first.cumsum(0))
    counts = torch.zeros_like(order).index_add_(0, inverse, torch.ones_like(order)).clamp_min(1)

    def means(values: Tensor) -> Tensor:
        sums = torch.zeros_like(values).index_add_(0, inverse, values)
        return (sums / counts[:, None])[inverse]

    rough = means(features)
    return rough, means(features - rough)


def _weighted_mean(values: Float[Tensor, "h w c"], weight: Tensor | None) -> Float[Tensor, ""]:
    if weight is None:
        return values.mean()
    weight = weight.to(values.dtype)
    total = weight.sum() * values.shape[-1]
    return (values * weight[..., None]).sum() / torch.where(total > 0, total, 1.0)


def _ssim(prediction: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    missing = [max(0, _SSIM_WINDOW - side) for side in prediction.shape[:2]]
    border = (missing[1] // 2, missing[1] - missing[1] // 2, missing[0] // 2, missing[0] - missing[0] // 2)
    images = [F.pad(image.permute(2, 0, 1)[None], border, mode="replicate") for image in (prediction, target)]
    if takes_kernels(prediction) and not target.requires_grad:
        from lang3dxl_ns.components.ssim import ssim as compiled_ssim

        return compiled_ssim(images[0][0], images[1][0].to(prediction))
    return ssim(*images, data_range=1.0, win=_window(images[0].device))


@functools.cache
def _window(device: torch.device) -> Float[Tensor, "3 1 1 11"]:
    """Return SSIM's Gaussian window, which is copied to a device once."""
    x = torch.arange(_SSIM_WINDOW, dtype=torch.float32) - _SSIM_WINDOW // 2
    weights = torch.exp(-(x**2) / (2 * 1.5**2))
    return to_device((weights / weights.sum()).expand(3, 1, 1, -1).contiguous(), device)
