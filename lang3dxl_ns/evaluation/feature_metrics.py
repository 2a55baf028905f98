"""How well decoded features match their targets, and how well the mean feature would."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def feature_metrics(
    kind: str,
    predicted: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    mean: Float[Tensor, " c"],
    weight: Float[Tensor, "h w"] | None = None,
) -> dict[str, float]:
    """L1, PSNR (peak 1) and cosine of `predicted`, each beside that of predicting the `mean` everywhere.

    On the raw scale of the encoder, as the encoder ablation of Lang3D-XL does. Cells without any weight
    (no foreground) do not count. Keys: `{kind}_l1`, `{kind}_psnr`, `{kind}_cosine`, and the same with
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
