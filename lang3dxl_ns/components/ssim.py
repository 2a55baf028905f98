"""SSIM (structural similarity) of two images and its gradient, in compiled kernels."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from lang3dxl_ns.common.jit import in_threads, kernel, ranges
from lang3dxl_ns.rendering.simd import LANES, load, store

WINDOW = 11
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2
_OFFSETS = np.arange(WINDOW) - WINDOW // 2
_GAUSSIAN = np.exp(-(_OFFSETS**2) / (2 * _SIGMA**2))
_GAUSSIAN /= _GAUSSIAN.sum()


def ssim(prediction: Float[Tensor, "c h w"], target: Float[Tensor, "c h w"]) -> Float[Tensor, ""]:
    """Compute the mean SSIM (Wang et al. 2004) of values in 0…1, over channels and windows (11 pixels, σ 1.5)
    inside the images, which are at least a window wide and high, on the CPU, in float32 or float64. The
    gradient reaches the prediction alone."""
    return _Similarity.apply(prediction, target)


class _Similarity(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor) -> Tensor:  # type: ignore[override]
        channels, height, width = prediction.shape
        lines = height - WINDOW + 1
        images = [_roomy(image) for image in (prediction, target)]
        weights = _GAUSSIAN.astype(images[0].dtype)
        # Derivatives by the blurred prediction, its blurred square, and the blurred product.
        slopes = np.empty((3, channels * lines, _padded(width)), images[0].dtype)
        parts = ranges(channels * lines)
        given = (*images, channels, height, width, weights, slopes)
        sums = in_threads(_similarity, [(*part, *given) for part in parts])
        ctx.images, ctx.slopes, ctx.weights, ctx.shape = images, slopes, weights, prediction.shape
        return prediction.new_tensor(sum(sums) / (channels * lines * (width - WINDOW + 1)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> Any:  # type: ignore[override]
        channels, height, width = ctx.shape
        gradient = np.empty((channels * height, _padded(width)), ctx.slopes.dtype)
        factor = float(upstream) / (channels * (height - WINDOW + 1) * (width - WINDOW + 1))
        parts = ranges(channels * height)
        shared = (*ctx.images, height, width, ctx.weights, ctx.slopes, factor, gradient)
        in_threads(_gradient, [(*part, *shared) for part in parts])
        return torch.from_numpy(gradient).view(channels, height, -1)[:, :, :width], None


def _padded(width: int) -> int:
    return -(-width // LANES) * LANES


def _roomy(image: Float[Tensor, "c h w"]) -> Float[np.ndarray, " entries"]:
    """Flatten the planes line by line, with each line padded to whole vectors, and one more at the end."""
    channels, height, width = image.shape
    room = image.new_zeros(channels * height * _padded(width) + LANES)
    room[:-LANES].view(channels, height, -1)[:, :, :width] = image.detach()
    return room.numpy()


@numba.njit(forceinline=True)
def _across(line, x, weights):
    """Blur across a line: compute the windows that begin at x and at the next `LANES` − 1 places."""
    blurred = load(line, x) * weights[0]
    for k in range(1, WINDOW):
        blurred += load(line, x + k) * weights[k]
    return blurred


@kernel
def _similarity(first, last, a, b, channels, height, width, weights, slopes):
    """Sum SSIM over a range of lines (all channels' one after another), and store the slopes."""
    lines, stride = height - WINDOW + 1, slopes.shape[2]
    means = np.zeros((5, stride + LANES), a.dtype)
    found = np.zeros(LANES, a.dtype)
    total = 0.0
    flat = slopes.reshape(-1)
    for line in range(first, last):
        start = (line // lines * height + line % lines) * stride
        for x in range(0, stride, LANES):
            va, vb = load(a, start + x), load(b, start + x)
            wa, wb = va * weights[0], vb * weights[0]
            ma, mb, maa, mbb, mab = wa, wb, va * wa, vb * wb, va * wb
            for k in range(1, WINDOW):
                va, vb = load(a, start + k * stride + x), load(b, start + k * stride + x)
                wa, wb = va * weights[k], vb * weights[k]
                ma += wa
                mb += wb
                maa += va * wa
                mbb += vb * wb
                mab += va * wb
            store(means[0], x, ma)
            store(means[1], x, mb)
            store(means[2], x, maa)
            store(means[3], x, mbb)
            store(means[4], x, mab)
        for x in range(0, width - WINDOW + 1, LANES):
            ma, mb = _across(means[0], x, weights), _across(means[1], x, weights)
            vaa = _across(means[2], x, weights) - ma * ma
            vbb = _across(means[3], x, weights) - mb * mb
            vab = _across(means[4], x, weights) - ma * mb
            a1, a2 = ma * mb * 2.0 + _C1, vab * 2.0 + _C2
            b1, b2 = ma * ma + mb * mb + _C1, vaa + vbb + _C2
            similarity, both = a1 * a2 / (b1 * b2), b1 * b2
            store(found, 0, similarity)
            for lane in range(min(LANES, width - WINDOW + 1 - x)):
                total += found[lane]
            at = line * stride + x
            plane = channels * lines * stride
            by_mean = mb * (a2 - a1) * 2.0 / both + ma * similarity * (1.0 / b2 - 1.0 / b1) * 2.0
            store(flat, at, by_mean)
            store(flat, plane + at, similarity * -1.0 / b2)
            store(flat, 2 * plane + at, a1 * 2.0 / both)
        for map_ in range(3):
            for x in range(width - WINDOW + 1, stride):
                slopes[map_, line, x] = 0
    return total


@kernel
def _gradient(first, last, a, b, height, width, weights, slopes, factor, gradient):
    """Compute the gradient by the first image for a range of its lines, from the slopes of all windows."""
    lines, stride = height - WINDOW + 1, slopes.shape[2]
    plane = slopes.shape[1] * stride
    flat, out = slopes.reshape(-1), gradient.reshape(-1)
    # Windows that begin up to ten places to the left reach a pixel, so there is room for them in front.
    sums = np.zeros((3, stride + 2 * LANES), a.dtype)
    for row in range(first, last):
        channel, y = row // height, row % height
        top, bottom = max(0, y - WINDOW + 1), min(lines - 1, y)
        for map_ in range(3):
            for x in range(0, stride, LANES):
                at = map_ * plane + channel * lines * stride + x
                total = load(flat, at + top * stride) * weights[y - top]
                for line in range(top + 1, bottom + 1):
                    total += load(flat, at + line * stride) * weights[y - line]
                store(sums[map_], LANES + x, total)
        for x in range(0, stride, LANES):
            # The window is symmetric, so the weights may be read forwards.
            begin = LANES + x - WINDOW + 1
            by_mean = _across(sums[0], begin, weights)
            by_square = _across(sums[1], begin, weights)
            by_product = _across(sums[2], begin, weights)
            va, vb = load(a, row * stride + x), load(b, row * stride + x)
            store(out, row * stride + x, (by_mean + va * by_square * 2.0 + vb * by_product) * factor)
