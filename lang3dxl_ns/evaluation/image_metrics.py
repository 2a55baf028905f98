"""Image metrics: PSNR and LPIPS of a rendered photo."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from rich import get_console
from torch import Tensor, nn


def psnr(predicted: Float[Tensor, "*shape"], target: Float[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio in decibels, for a peak of 1."""
    return -10 * torch.log10(F.mse_loss(predicted, target).clamp_min(1e-10))


class Lpips:
    """LPIPS (AlexNet), loaded at first use; skipped if its weights are unavailable, as offline.

    Not an nn.Module, so that AlexNet stays out of checkpoints.
    """

    def __init__(self) -> None:
        self._metric: nn.Module | None = None
        self._available = True

    def __call__(self, target: Float[Tensor, "1 3 h w"], predicted: Float[Tensor, "1 3 h w"]) -> float | None:
        """Distance of two images in [0, 1]; None without weights."""
        if self._metric is None and self._available:
            from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

            try:
                self._metric = LearnedPerceptualImagePatchSimilarity(normalize=True)
            except (OSError, RuntimeError) as error:  # no Internet; a damaged or intercepted download
                get_console().log(f"LPIPS is skipped: its weights cannot be loaded ({error})")
                self._available = False
        if self._metric is None:
            return None
        return float(self._metric.to(target.device)(target, predicted.clamp(0, 1)))
