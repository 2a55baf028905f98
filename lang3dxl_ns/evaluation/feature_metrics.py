"""Feature metrics: L1, PSNR and cosine of decoded features against targets, beside the mean feature's."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.components.downsampler import AttenuatedDownsampler, DownsamplerConfig


def match(
    features: Float[Tensor, "h w c"],
    target: Float[Tensor, "hd wd c"],
    crop_sides: Sequence[float],
    mask: Float[Tensor, "h w"] | None = None,
) -> tuple[Float[Tensor, "hd wd c"], Float[Tensor, "hd wd"]]:
    """Average features over the target's crops, and compute the weight of each cell. The kernel is the
    downsampler's without its learned attenuation, so it is the same for every way of training."""
    kernel = AttenuatedDownsampler(DownsamplerConfig(hidden=0), features.shape[-1])
    return kernel(features, (target.shape[0], target.shape[1]), crop_sides, mask)


def feature_metrics(
    kind: str,
    predicted: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    mean: Float[Tensor, " c"],
    weight: Float[Tensor, "h w"] | None = None,
) -> dict[str, float]:
    """Compute L1, PSNR (peak 1) and cosine of `predicted`, and the same for predicting the `mean` everywhere.

    Features are compared on the encoder's own scale, as in Lang3D-XL's encoder ablation. Cells of zero weight
    (no foreground) are ignored. Keys are `{kind}_l1`, `{kind}_psnr` and `{kind}_cosine`, and the same with
    `_of_mean` appended.
    """
    cells = target.new_ones(target.shape[:2], dtype=torch.bool) if weight is None else weight > 0
    if not cells.any():
        return {}
    metrics = _agreement(predicted[cells], target[cells])
    baseline = _agreement(mean.expand_as(target)[cells], target[cells])
    return {f"{kind}_{name}": value for name, value in metrics.items()} | {
        f"{kind}_{name}_of_mean": value for name, value in baseline.items()
    }


def _agreement(predicted: Float[Tensor, "n c"], target: Float[Tensor, "n c"]) -> dict[str, float]:
    difference = predicted.double() - target.double()
    return {
        "l1": float(difference.abs().mean()),
        "psnr": -10 * math.log10(max(float(difference.square().mean()), 1e-12)),
        "cosine": float(torch.cosine_similarity(predicted.double(), target.double(), dim=-1).mean()),
    }
