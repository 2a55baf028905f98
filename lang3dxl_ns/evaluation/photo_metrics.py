"""Evaluated photo: PSNR, SSIM, LPIPS of its rendering; L1, PSNR and cosine of its decoded features."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from PIL import Image
from pytorch_msssim import SSIM
from torch import Tensor, nn

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler, DownsamplerConfig
from lang3dxl_ns.evaluation.scores import Maps

ALEXNET = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
"""Address of the AlexNet weights that LPIPS uses, as torchvision publishes them."""


@dataclass
class EvaluatedPhoto:
    """Figures of a photo, and the pictures behind them."""

    name: str
    metrics: dict[str, float]
    """Figures of the photo: psnr etc., `render_seconds`, and with appearance `half_psnr` etc. With ground
    truth also `query_seconds`, and `ap_{category}` etc. with the prefixes of `evaluation.aggregate`."""
    images: dict[str, Tensor]
    """Pictures by name: `img` (photo beside rendering, [H, 2W, 3]), with semantics `bottleneck`, and with
    appearance `fitted`, the rendering in the look of the half-image protocol."""
    maps: Maps
    """Relevancy by category, as queries show it, at the size of scoring; empty without ground truth."""

    def write_pictures(self, folder: Path) -> None:
        """Write every picture to `folder` as a JPEG named after the photo."""
        folder.mkdir(parents=True, exist_ok=True)
        photo = re.sub(r"[^A-Za-z0-9._-]", "_", self.name)[-80:]
        if photo != self.name:  # photos of two folders may be called alike
            photo += f".{hashlib.sha256(os.fsencode(self.name)).hexdigest()[:8]}"
        for name, image in self.images.items():
            pixels = (image.clamp(0, 1) * 255).byte().cpu().numpy()
            Image.fromarray(pixels).save(folder / f"{photo}.{name}.jpg")


def psnr(predicted: Float[Tensor, "*shape"], target: Float[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Compute the peak signal-to-noise ratio in decibels, for a peak of 1."""
    return -10 * torch.log10(F.mse_loss(predicted, target).clamp_min(1e-10))


def reached(photo: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None) -> Bool[Tensor, "h w"]:
    """Return which pixels a photo has. Undistortion leaves black where the photo does not reach, outside its
    mask. A photo that has no pixel at all counts whole."""
    if mask is None:
        return torch.ones(photo.shape[:2], dtype=torch.bool, device=photo.device)
    pixels = mask | (photo > 0).any(-1)
    return pixels | ~pixels.any()


@torch.no_grad()
def corrected_psnr(
    predicted: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None = None
) -> float:
    """Compute PSNR (dB) with matched colors, where a photo with a mask reaches; a large photo takes
    seconds."""
    pixels = reached(target, mask)
    # Colors are matched on the CPU, whose solver also handles pictures of a single color.
    wanted, colors = target[pixels].cpu(), predicted[pixels].cpu()
    return float(psnr(matched_colors(colors, wanted), wanted))


def matched_colors(
    colors: Float[Tensor, "n 3"], wanted: Float[Tensor, "n 3"], rounds: int = 5
) -> Float[Tensor, "n 3"]:
    """Map colors (0…1) as near to the wanted ones as a quadratic polynomial can (least squares): the "cc" of
    Mip-NeRF 360's and Zip-NeRF's figures. Saturated colors only bound the true ones and are left out of the
    fit. Which ones are changes with the fit, so it is repeated."""
    left, right = torch.triu_indices(3, 3)
    usable = _unsaturated(colors) & _unsaturated(wanted)
    for _ in range(rounds):
        terms = torch.cat([colors[:, left] * colors[:, right], colors, torch.ones_like(colors[:, :1])], dim=1)
        weights = (usable & _unsaturated(colors)).to(terms)
        fits = [
            torch.linalg.lstsq(terms * weight, color * weight).solution
            for weight, color in zip(weights.T[..., None], wanted.T[..., None], strict=True)
        ]
        colors = (terms @ torch.cat(fits, dim=1)).clamp(0.0, 1.0)
    return colors


def _unsaturated(colors: Float[Tensor, "n 3"]) -> Bool[Tensor, "n 3"]:
    return (colors - 0.5).abs() <= 0.5 - 0.5 / 255


class ImageMetrics:
    """Metrics of a rendering. It is not an nn.Module, so that its networks stay out of checkpoints."""

    def __init__(self) -> None:
        self._ssim = SSIM(data_range=1.0, size_average=True, channel=3)

    @torch.no_grad()
    def __call__(
        self,
        predicted: Float[Tensor, "h w 3"],
        target: Float[Tensor, "h w 3"],
        mask: Bool[Tensor, "h w"] | None = None,
    ) -> dict[str, float]:
        """Compute `psnr` (dB), `ssim`, and `lpips` if its weights are available, where a photo with a mask
        reaches."""
        pixels = reached(target, mask)
        predicted = torch.where(pixels[..., None], predicted, target)
        chw = [image.permute(2, 0, 1)[None] for image in (target, predicted)]
        metrics = {"psnr": float(psnr(predicted[pixels], target[pixels])), "ssim": float(self._ssim(*chw))}
        if self._lpips is not None:
            metrics["lpips"] = float(self._lpips.to(target.device)(chw[0], chw[1].clamp(0, 1)))
        return metrics

    @cached_property
    def _lpips(self) -> nn.Module | None:
        """LPIPS (AlexNet), loaded at first use, or None if its weights are not in torch's cache: nothing is
        downloaded without a request."""
        weights = Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET.rpartition("/")[2]
        if not weights.is_file():
            say(f"LPIPS is skipped: it needs {ALEXNET}, put into {weights.parent}")
            return None
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        try:
            return LearnedPerceptualImagePatchSimilarity(normalize=True)
        except (OSError, RuntimeError) as error:  # damaged file
            say(f"LPIPS is skipped: its weights cannot be loaded ({error})")
            return None


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
    """Compute L1, PSNR (peak 1) and cosine of `predicted`, `{kind}_l1` etc., and the same for predicting the
    `mean` everywhere, with `_of_mean` appended. Features are compared on the encoder's own scale, as in
    Lang3D-XL's encoder ablation. Cells of zero weight (no foreground) are ignored."""
    cells = target.new_ones(target.shape[:2], dtype=torch.bool) if weight is None else weight > 0
    if not cells.any():
        return {}
    figures, wanted = {}, target[cells].double()
    for whose, features in (("", predicted), ("_of_mean", to_device(mean, target.device).expand_as(target))):
        found = features[cells].double()
        figures[f"{kind}_l1{whose}"] = float(F.l1_loss(found, wanted))
        figures[f"{kind}_psnr{whose}"] = float(psnr(found, wanted))
        figures[f"{kind}_cosine{whose}"] = float(F.cosine_similarity(found, wanted, dim=-1).mean())
    return figures
