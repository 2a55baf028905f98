"""Attenuated downsampler: from a decoded feature map to the grid of the CLIP targets.

A CLIP target is a mean over crops of several sizes, so each cell covers a wide neighborhood. In training the
decoded map is blurred likewise before the two are compared: a fixed kernel with the footprint of the crops is
multiplied by learned per-pixel weights. Every kernel is a sum of boxes, and therefore separable: sum_j A_j X
B_jᵀ, where the small matrices A_j and B_j contain window, resize and centering along each axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lang3dxl_ns.common.device import in_full_precision

KernelName = Literal["pyramid", "box"]

# exp(-2 * 30) is far above the smallest float32, so one maximum over the whole map serves every window.
_LARGEST_BOUND_FOR_ONE_MAXIMUM = 30.0
_ROUND_OFF = 1e-9  # share of a window; smaller coverage is rounding error, not a pixel


@dataclass(frozen=True)
class DownsamplerConfig:
    """Settings of how a decoded map is reduced to the target grid."""

    kernel: KernelName | Literal["auto"] = "auto"
    """Fixed part of the weights. pyramid: nested squares from the smallest crop to the largest, growing by
    √2, favoring small ones (the published system's kernel). box: the cell alone, as in the paper's formula;
    much too narrow for targets that are a mean over scales. auto: box with the semantic field's preset
    `paper`, otherwise pyramid."""
    hidden: int | None = None
    """Width of the network that predicts the weights; 0 keeps the fixed kernel and builds no network. None:
    512, as published, with the semantic field's presets `paper` and `official`, otherwise 16, which is about
    thirty times as fast on a CPU."""
    logit_bound: float | None = 10.0
    """Bound b of the learned weights' logits: w becomes b·tanh(w/b), so that no pixel outweighs another by
    more than exp(2b). None leaves them unbounded and takes a slower path that is stable for any logits."""
    match: Literal["attenuated", "resize-features", "resize-target"] = "attenuated"
    """How features and target are brought to one grid. attenuated: by this downsampler. The others are the
    paper's ablations, for which the settings above have no effect. resize-features: features are resized
    bilinearly to the target's grid ("w/o AD (LR)"). resize-target: the target is resized bilinearly to the
    features' size ("w/o AD (HR)")."""

    def resolved(self, preset: str | None = None) -> DownsamplerConfig:
        """Replace `auto` and None by the values for the semantic field's preset."""
        kernel, hidden = self.kernel, self.hidden
        if kernel == "auto":
            kernel = "box" if preset == "paper" else "pyramid"
        if hidden is None:
            hidden = 512 if preset in ("paper", "official") else 16
        return replace(self, kernel=kernel, hidden=hidden)


class SeparableKernel(NamedTuple):
    """Kernel K[i, k, p, q] = sum_j rows[j, i, p] · columns[j, k, q], with sum 1 over a window in the map."""

    rows: Float[Tensor, "j hd h"]
    columns: Float[Tensor, "j wd w"]


class AttenuatedDownsampler(nn.Module):
    """Kernel- and attention-weighted mean of a feature map around every cell of a target grid (Lang3D-XL §3).

    It is out(o) = Σ_i K(o, i) m_i exp(w_i) f_i / Σ_i K(o, i) m_i exp(w_i), with the kernel K centered on the
    cell, the mask m, and logits w from three 3×3 convolutions over f. Both sums omit the part of a window
    outside the map. The last convolution starts at zero, so training starts from the plain kernel mean.
    """

    def __init__(
        self, config: DownsamplerConfig, channels: int, *, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        self.config = config = config.resolved()
        assert config.kernel != "auto" and config.hidden is not None  # resolved
        self.kernel: KernelName = config.kernel
        learned = config.hidden and config.match == "attenuated"
        self.network = _weight_network(channels, config.hidden, generator) if learned else None

    def match(
        self,
        features: Float[Tensor, "h w c"],
        target: Float[Tensor, "hd wd c"],
        crop_sides: Sequence[float],
        mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | None = None,
    ) -> tuple[Float[Tensor, "a b c"], Float[Tensor, "a b c"], Float[Tensor, "a b"]]:
        """Bring features and target to one grid, the target's unless configured otherwise. Return both, and
        the cells' loss weight (the share described in `forward`)."""
        inside = features.new_ones(features.shape[:2]) if mask is None else mask.to(features.dtype)
        if self.config.match == "resize-target":
            return features, _resized(target, (features.shape[0], features.shape[1])), inside
        grid = (target.shape[0], target.shape[1])
        if self.config.match == "resize-features":
            share = _resized(inside[..., None], grid)[..., 0]
            return _divide(_resized(features * inside[..., None], grid), share), target, share
        predicted, share = self(features, grid, crop_sides, mask)
        return predicted, target, share

    def forward(
        self,
        features: Float[Tensor, "h w c"],
        grid: tuple[int, int],
        crop_sides: Sequence[float],
        mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | None = None,
    ) -> tuple[Float[Tensor, "hd wd c"], Float[Tensor, "hd wd"]]:
        """Downsample features, and compute the share of each window's kernel inside the map and the mask.

        `grid` is (rows, columns) of the target. `crop_sides` are the sides of the crops that the target
        averages, smallest first, as fractions of the photo's width; the map has the photo's aspect ratio.
        Where the share is 0, features are 0 and pass no gradient; elsewhere it serves as the loss weight.
        Features outside the mask have no influence. Raises ValueError for crop sides that are not positive
        and ascending.
        """
        masked = features if mask is None else features * mask.to(features.dtype)[..., None]
        logits = None if self.network is None else self.logits(masked)
        return self._average(features, grid, tuple(float(side) for side in crop_sides), mask, logits)

    @in_full_precision
    def _average(
        self,
        features: Float[Tensor, "h w c"],
        grid: tuple[int, int],
        sides: tuple[float, ...],
        mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | None,
        logits: Float[Tensor, "h w"] | None,
    ) -> tuple[Float[Tensor, "hd wd c"], Float[Tensor, "hd wd"]]:
        h, w, _ = features.shape
        kernel = separable_kernel(self.kernel, (h, w), grid, sides, features.dtype, features.device)
        inside = features.new_ones(h, w) if mask is None else mask.to(features.dtype)
        share = apply_kernel(kernel, inside[..., None]).squeeze(-1)
        if logits is None:
            masked = features if mask is None else features * inside[..., None]
            return _divide(apply_kernel(kernel, masked), share), share
        bound = self.config.logit_bound
        one_maximum = bound is not None and bound <= _LARGEST_BOUND_FOR_ONE_MAXIMUM
        mean = mean_with_one_maximum if one_maximum else mean_with_window_maxima
        return mean(kernel, features, logits, inside), share

    def logits(self, features: Float[Tensor, "h w c"]) -> Float[Tensor, "h w"]:
        """Compute the log of every pixel's learned weight, bounded as configured; zero without a network."""
        if self.network is None:
            return features.new_zeros(features.shape[:2])
        logits = self.network(features.permute(2, 0, 1)[None])[0, 0]
        bound = self.config.logit_bound
        return logits if bound is None else bound * torch.tanh(logits / bound)


def mean_with_one_maximum(
    kernel: SeparableKernel,
    features: Float[Tensor, "h w c"],
    logits: Float[Tensor, "h w"],
    mask: Float[Tensor, "h w"],
) -> Float[Tensor, "hd wd c"]:
    """Compute every window's weighted mean with one shift of the (bounded) logits for the whole map."""
    weights = torch.exp(logits - logits.detach().max()) * mask
    mass = apply_kernel(kernel, weights[..., None]).squeeze(-1)
    return _divide(apply_kernel(kernel, features * weights[..., None]), mass)


def mean_with_window_maxima(
    kernel: SeparableKernel,
    features: Float[Tensor, "h w c"],
    logits: Float[Tensor, "h w"],
    mask: Float[Tensor, "h w"],
) -> Float[Tensor, "hd wd c"]:
    """Compute every window's weighted mean with its own shift of the logits; for any logits, −∞ included.
    This works axis by axis. Along y every window has its own maximum, which is subtracted before `exp`; along
    x those maxima are the logits. Only differences of logits are taken, and no logarithm. A shift changes no
    mean, so the maxima carry no gradient."""
    (boxes, hd, h), (_, wd, w) = kernel.rows.shape, kernel.columns.shape
    rows = kernel.rows.reshape(boxes * hd, h)
    along_y, maxima = _exp_shifted((logits + (mask > 0).log()).T[:, None], rows)  # [w, j·hd, h]
    values = torch.cat([features, torch.ones_like(logits)[..., None]], dim=-1) * mask[..., None]
    sums = (along_y @ values.transpose(0, 1)).view(w, boxes, hd, -1).permute(2, 1, 0, 3)
    sums = sums.reshape(hd, boxes * w, -1)
    columns = kernel.columns.transpose(0, 1).reshape(wd, boxes * w)
    maxima = maxima.view(w, boxes, hd).permute(2, 1, 0).reshape(hd, 1, boxes * w)
    total = _exp_shifted(maxima, columns)[0] @ sums  # [hd, wd, c + 1]
    return _divide(total[..., :-1], total[..., -1])


def _exp_shifted(
    logits: Float[Tensor, "b one_or_n a"], kernel: Float[Tensor, "n a"]
) -> tuple[Float[Tensor, "b n a"], Float[Tensor, "b n"]]:
    """Compute kernel · exp(logits − m) and m, the logits' maximum where the kernel is not 0 (−∞ for none)."""
    inside = torch.where(kernel > 0, logits, -torch.inf)
    maxima = inside.detach().amax(-1)
    return kernel * torch.exp(inside - maxima.clamp(min=torch.finfo(maxima.dtype).min)[..., None]), maxima


def apply_kernel(kernel: SeparableKernel, values: Float[Tensor, "h w c"]) -> Float[Tensor, "hd wd c"]:
    """Compute sum_j A_j X B_jᵀ for every channel, by two matrix products in the cheaper order."""
    (boxes, hd, h), (_, wd, w) = kernel.rows.shape, kernel.columns.shape
    c = values.shape[-1]
    if hd * w * (h + wd) <= wd * h * (w + hd):
        rows = kernel.rows.transpose(0, 1).reshape(hd * boxes, h)
        partial = (rows @ values.reshape(h, w * c)).view(hd, boxes * w, c)
        return kernel.columns.transpose(0, 1).reshape(wd, boxes * w) @ partial
    partial = kernel.columns.reshape(boxes * wd, w) @ values
    rows = kernel.rows.permute(1, 2, 0).reshape(hd, h * boxes)
    return (rows @ partial.view(h * boxes, wd * c)).view(hd, wd, c)


@lru_cache(maxsize=128)
@torch.inference_mode(False)  # otherwise a matrix cached during evaluation could not be used in training
def separable_kernel(
    name: KernelName,
    size: tuple[int, int],
    grid: tuple[int, int],
    sides: tuple[float, ...],
    dtype: torch.dtype,
    device: torch.device,
) -> SeparableKernel:
    """Build the kernel's matrices for a map size, a target grid and crop sides (fractions of the width).
    Raises ValueError for crop sides that are not positive and ascending."""
    if not sides or sides[0] <= 0 or list(sides) != sorted(sides):
        raise ValueError(f"crop_sides must be positive and ascending, smallest first; got {sides}")
    if name == "pyramid":
        # The published weights are (2√2)^-j per unit of area; times the area of square j, they are √2^-j.
        count = 1 + math.floor(2 * math.log2(sides[-1] / sides[0]) + 1e-6)
        squares = [sides[0] * size[1] * math.sqrt(2) ** j for j in range(count)]
        rows, columns = _nested_rows(size[0], grid[0], squares), _nested_rows(size[1], grid[1], squares)
        masses = math.sqrt(0.5) ** torch.arange(count, dtype=torch.float64)
    else:
        rows, columns = (_nested_rows(a, n, [a / n]) for a, n in zip(size, grid, strict=True))
        masses = torch.ones(1, dtype=torch.float64)
    rows = rows * (masses / masses.sum())[:, None, None]
    return SeparableKernel(rows.to(device, dtype), columns.to(device, dtype))


def _resized(values: Float[Tensor, "h w c"], grid: tuple[int, int]) -> Float[Tensor, "hd wd c"]:
    """Resize like the paper's ablations: bilinearly, from the nearest pixels alone (no antialiasing)."""
    return F.interpolate(values.permute(2, 0, 1)[None], grid, mode="bilinear")[0].permute(1, 2, 0)


def _nested_rows(size: int, cells: int, sides: Sequence[float]) -> Float[Tensor, "j n a"]:
    """Build windows of the given sides (pixels) around the center of every cell of an axis."""
    centers = (torch.arange(cells, dtype=torch.float64) + 0.5) * (size / cells)
    return torch.stack([_window_means(size, centers, side) for side in sides])


def _window_means(size: int, centers: Float[Tensor, " n"], side: float) -> Float[Tensor, "n a"]:
    """Compute the weights of an axis' pixels in windows of the given side, as shares of the whole window. A
    pixel counts by the part of it that the window covers, sampled at that part's center by interpolating
    between neighboring pixels. So whole pixels are averaged, a window narrower than a pixel interpolates, and
    a ramp keeps its position exactly wherever the window is inside the map."""
    pixel = torch.arange(size, dtype=torch.float64)
    start = torch.maximum(centers[:, None] - side / 2, pixel)
    end = torch.minimum(centers[:, None] + side / 2, pixel + 1)
    covered = (end - start).clamp(min=0) / side
    offset = (start + end) / 2 - (pixel + 0.5)
    weights = covered * (1 - offset.abs())
    to_next, to_previous = covered * offset.clamp(min=0), covered * (-offset).clamp(min=0)
    weights[:, 1:] += to_next[:, :-1]
    weights[:, -1] += to_next[:, -1]
    weights[:, :-1] += to_previous[:, 1:]
    weights[:, 0] += to_previous[:, 0]
    return torch.where(weights > _ROUND_OFF, weights, 0.0)


def _weight_network(channels: int, hidden: int, generator: torch.Generator | None) -> nn.Sequential:
    """Build three 3×3 convolutions to one logit, initialized from the given generator alone."""
    widths = (channels, hidden, hidden, 1)
    first, second, last = (
        nn.utils.skip_init(nn.Conv2d, a, b, kernel_size=3, padding=1) for a, b in pairwise(widths)
    )
    for layer in (first, second):
        nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
    nn.init.zeros_(last.weight)
    for layer in (first, second, last):
        nn.init.zeros_(layer.bias)
    network = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last)
    # The map is channels-last, and weights in the same layout halve the convolutions' time on a CPU.
    return nn.utils.convert_conv2d_weight_memory_format(network, torch.channels_last)


def _divide(total: Float[Tensor, "hd wd c"], mass: Float[Tensor, "hd wd"]) -> Float[Tensor, "hd wd c"]:
    """Return total / mass, or 0 without gradient where mass (and so total) is 0."""
    return total / torch.where(mass > 0, mass, 1.0)[..., None]
