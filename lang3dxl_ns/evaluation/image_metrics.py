"""Image metrics: PSNR and LPIPS of a rendered photo."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.common.console import say

ALEXNET = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
"""Address of the AlexNet weights that LPIPS uses, as torchvision publishes them."""


def psnr(predicted: Float[Tensor, "*shape"], target: Float[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Compute the peak signal-to-noise ratio in decibels, for a peak of 1."""
    return -10 * torch.log10(F.mse_loss(predicted, target).clamp_min(1e-10))


class Lpips:
    """LPIPS (AlexNet), loaded at first use.

    It is skipped unless its weights are in torch's cache, because nothing is downloaded without a request. It
    is not an nn.Module, so that AlexNet stays out of checkpoints.
    """

    @cached_property
    def _metric(self) -> nn.Module | None:
        if not _weights().is_file():
            say(f"LPIPS is skipped: it needs {ALEXNET}, put into {_weights().parent}")
            return None
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        try:
            return LearnedPerceptualImagePatchSimilarity(normalize=True)
        except (OSError, RuntimeError) as error:  # damaged file
            say(f"LPIPS is skipped: its weights cannot be loaded ({error})")
            return None

    def __call__(self, target: Float[Tensor, "1 3 h w"], predicted: Float[Tensor, "1 3 h w"]) -> float | None:
        """Compute the distance of two images in [0, 1]; None without weights."""
        if self._metric is None:
            return None
        return float(self._metric.to(target.device)(target, predicted.clamp(0, 1)))


def _weights() -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET.rpartition("/")[2]
