"""Hard cases of the losses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from lab.numerics.measure import EXACT, Bounds, Case, Maps, Problem, narrowed
from lang3dxl_ns.components.losses import clip_loss, dense_loss, region_variance_loss, rgb_loss

BOUNDS = {"float32": Bounds(2e-6, 2e-6, 1e-4, 1e-5), "float64": EXACT}
SSIM_BOUNDS = {"float32": Bounds(1e-4, 1e-4, 5e-3, 1e-3), "float64": Bounds(1e-5, 1e-5, 1e-4, 1e-4)}
HALF = {"bf16": Bounds(1e-2, 1e-2, 2.0, 5e-2), "fp16": Bounds(2e-3, 2e-3, 2.0, 5e-2)}
SSIM_NOTE = (
    "pytorch-msssim's variance is a difference of means of squares and its window is in float32; errors are "
    "relative to a loss of 0.1 at least"
)
HALF_NOTE = "a prediction rounded to 16 bits may cross its target: the sign of that gradient turns"


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Yield cases of the color, CLIP, dense and region losses."""
    yield from _color_cases()
    yield from _feature_cases()
    yield from _region_cases(quick)


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# --- colors ----------------------------------------------------------------------------------------------


def _color_cases() -> Iterator[Case]:
    image, other = _random(24, 30, 3), _random(24, 30, 3, seed=1)
    black = torch.zeros_like(image)
    one = torch.zeros(24, 30, dtype=torch.float64)
    one[5, 7] = 1
    pairs: dict[str, tuple[Tensor, Tensor, Tensor | None]] = {
        "usual": (image, other, None),
        "black photo": (image, black, None),
        "black photo, black image": (black, black, None),
        "equal images": (image, image, None),
        "flat and bright": (0.99 + 1e-4 * image, 0.99 + 1e-4 * other, None),
        "exposure 100× off": (image, 100 * other, None),
        "exposure 1/100": (image, 0.01 * other, None),
        "no foreground": (image, other, 0 * one),
        "one pixel of foreground": (image, other, one),
        "1×1": (image[:1, :1], other[:1, :1], None),
        "1×400": (_random(1, 400, 3), _random(1, 400, 3, seed=1), None),
    }
    for name, (prediction, target, mask) in pairs.items():
        yield Case("loss: color", name, _color(prediction, target, mask), SSIM_BOUNDS, SSIM_NOTE)
    narrow = _color(image, other, None, narrow=True)
    yield Case("loss: color", "mixed precision, 16-bit image", narrow, HALF, HALF_NOTE)


def _color(
    prediction: Tensor, target: Tensor, mask: Tensor | None, narrow: bool = False
) -> Callable[[], Problem]:
    def compute(leaves: Maps) -> Maps:
        used = None if mask is None else mask.to(leaves["prediction"].device)
        image = narrowed(leaves["prediction"]) if narrow else leaves["prediction"]
        return {"loss": rgb_loss(image, leaves["target"], used)}

    def reference(leaves: Maps) -> Maps:
        return {"loss": color_reference(leaves["prediction"], leaves["target"], mask)}

    leaves = {"prediction": prediction.clone(), "target": target.clone()}
    fixed = frozenset({"target"})
    return lambda: Problem(leaves, compute, reference, constants=fixed, output_scale=0.1, gradient_scale=1e-4)


def color_reference(prediction: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """Compute ½ L1 + ½ (1 − SSIM), window by window, with two-pass variances."""
    if mask is not None and not mask.any():
        return 0 * prediction.sum()
    weight = torch.ones_like(prediction[..., 0]) if mask is None else mask.to(prediction)
    l1 = ((prediction - target).abs() * weight[..., None]).sum() / (3 * weight.sum())
    offsets = torch.arange(11, dtype=torch.float64) - 5
    gauss = torch.exp(-offsets.square() / (2 * 1.5**2))
    window = torch.outer(gauss, gauss).flatten().to(prediction) / gauss.sum() ** 2
    missing = [max(0, 11 - side) for side in prediction.shape[:2]]
    border = (missing[1] // 2, missing[1] - missing[1] // 2, missing[0] // 2, missing[0] - missing[0] // 2)
    a, b = (
        F.unfold(F.pad(image.permute(2, 0, 1)[:, None], border, mode="replicate"), 11).mT
        for image in (prediction, target)
    )
    mean_a, mean_b = (a @ window)[..., None], (b @ window)[..., None]
    variance_a, variance_b = (a - mean_a).square() @ window, (b - mean_b).square() @ window
    covariance = ((a - mean_a) * (b - mean_b)) @ window
    mean_a, mean_b = mean_a[..., 0], mean_b[..., 0]
    luminance = (2 * mean_a * mean_b + 0.01**2) / (mean_a**2 + mean_b**2 + 0.01**2)
    structure = (2 * covariance + 0.03**2) / (variance_a + variance_b + 0.03**2)
    return 0.5 * l1 + 0.5 * (1 - (luminance * structure).mean())


# --- features ---------------------------------------------------------------------------------------------


def _feature_cases() -> Iterator[Case]:
    target = _random(6, 8, 16)
    close = {"prediction": 1e4 + 1e-3 * _random(6, 8, 16, seed=1)}
    weights = {
        "usual": torch.ones(6, 8, dtype=torch.float64),
        "no weight": torch.zeros(6, 8, dtype=torch.float64),
        "weights 1e-30": torch.full((6, 8), 1e-30, dtype=torch.float64),
        "weights from 1e-12 to 1": torch.logspace(-12, 0, 48, dtype=torch.float64).view(6, 8),
    }
    usual = {"prediction": _random(6, 8, 16, seed=1)}
    for name, weight in weights.items():
        yield Case("loss: CLIP", name, _feature("clip", usual, target, weight), BOUNDS)
    far = 1e4 + 1e-3 * target
    yield Case(
        "loss: CLIP", "mean 1e4, deviation 1e-3", _feature("clip", close, far, weights["usual"]), BOUNDS
    )
    large = {"prediction": 1e18 * usual["prediction"]}
    yield Case("loss: CLIP", "features of 1e18", _feature("clip", large, target, weights["usual"]), BOUNDS)
    for size in ((5, 9), (40, 52), (1, 1)):
        maps = {"prediction": _random(*size, 16, seed=2)}
        name = f"map {size[0]}×{size[1]} for a target of 6×8"
        yield Case("loss: dense", name, _feature("dense", maps, target, weights["usual"]), BOUNDS)
    large_map = {"prediction": 30 * _random(64, 64, 16)}
    far_target = _random(64, 64, 16, seed=3)
    mixed = _feature("clip", large_map, far_target, torch.ones(64, 64, dtype=torch.float64), narrow=True)
    yield Case("loss: CLIP", "mixed precision, sum above 65504", mixed, HALF, HALF_NOTE)


def _feature(
    kind: str, leaves: Maps, target: Tensor, weight: Tensor, narrow: bool = False
) -> Callable[[], Problem]:
    def compute(given: Maps) -> Maps:
        prediction = narrowed(given["prediction"]) if narrow else given["prediction"]
        if kind == "dense":
            return {"loss": dense_loss(prediction, given["target"])}
        return {"loss": clip_loss(prediction, given["target"], given["weight"])}

    def reference(given: Maps) -> Maps:
        prediction, wanted, weights = given["prediction"], given["target"], given["weight"][..., None]
        if kind == "dense":
            return {"loss": (_resized(prediction, wanted.shape[:2]) - wanted).abs().mean()}
        total = weights.sum() * wanted.shape[2]
        return {"loss": ((prediction - wanted).abs() * weights).sum() / (total if total > 0 else 1)}

    given = {name: value.clone() for name, value in leaves.items()} | {"target": target, "weight": weight}
    return lambda: Problem(given, compute, reference, constants=frozenset({"target", "weight"}))


def _resized(values: Tensor, grid: torch.Size) -> Tensor:
    """Resize with a triangle filter as wide as a cell of the coarser grid, as two dense matrices."""
    for axis, cells in enumerate(grid):
        size = values.shape[axis]
        scale = size / cells
        centers = (torch.arange(cells, dtype=torch.float64) + 0.5) * scale
        distance = (torch.arange(size, dtype=torch.float64) + 0.5 - centers[:, None]).abs()
        matrix = (1 - distance / max(scale, 1.0)).clamp_min(0)
        matrix = (matrix / matrix.sum(1, keepdim=True)).to(values)
        values = torch.tensordot(matrix, values, ([1], [axis])).movedim(0, axis)
    return values


# --- regions ----------------------------------------------------------------------------------------------


def _region_cases(quick: bool) -> Iterator[Case]:
    many = 10_000 if quick else 100_000
    side = 2 * math.isqrt(many) + 2
    features, shifted = _random(20, 30, 8), 1e4 + 1e-3 * _random(20, 30, 8)
    labels = {
        "usual": torch.arange(20)[:, None] // 5 * 3 + torch.arange(30) // 10,
        "no region": torch.full((20, 30), -1),
        "regions of 1 pixel": torch.arange(600).view(20, 30),
        "regions of 2 pixels": torch.arange(600).view(20, 30) // 2,
        "one region of the whole photo": torch.zeros(20, 30, dtype=torch.long),
        "labels of 10^12": torch.arange(600).view(20, 30) // 50 * 10**12,
    }
    for name, label in labels.items():
        yield Case("loss: regions", name, _region(features, label), BOUNDS)
        canceling = {"float32": Bounds(1e-5, 1e-5, 1e-4, 1e-5), "float64": Bounds(1e-8, 1e-8, 1e-6, 1e-6)}
        yield Case("loss: regions", f"{name}, mean 1e4, deviation 1e-3", _region(shifted, label), canceling)
    large = torch.arange(side * side).view(side, side) * many // side**2
    yield Case("loss: regions", f"{many:,} regions", _region(_random(side, side, 4), large), BOUNDS)
    mixed = _region(30 * _random(64, 64, 8), torch.zeros(64, 64, dtype=torch.long), narrow=True)
    yield Case("loss: regions", "mixed precision, sum above 65504", mixed, HALF, HALF_NOTE)


def _region(features: Tensor, labels: Tensor, narrow: bool = False) -> Callable[[], Problem]:
    def compute(leaves: Maps) -> Maps:
        values = narrowed(leaves["features"]) if narrow else leaves["features"]
        return {"loss": region_variance_loss(values, labels.to(values.device))}

    def reference(leaves: Maps) -> Maps:
        values, label = leaves["features"].flatten(0, 1), labels.flatten().to(leaves["features"].device)
        valid = label >= 0
        if not valid.any():
            return {"loss": 0 * values.sum()}
        _, region = torch.unique(label[valid], return_inverse=True)
        values = values[valid]
        values = values - values.detach().mean(0)  # a shift does not change the variance
        count = torch.bincount(region)
        sums = torch.zeros(len(count), values.shape[1]).to(values).index_add(0, region, values)
        deviations = values - (sums / count[:, None])[region]
        return {"loss": deviations.square().sum() / valid.sum()}

    return lambda: Problem({"features": features.clone()}, compute, reference)
