"""Reference of the downsampler in float64: loops over the pixels of every window."""

import itertools
import math

import numpy as np
import torch


def axis_window(size, center, side):
    """Average over [center ± side/2], pixel piece by pixel piece, each sampled at its middle."""
    weights = np.zeros(size)
    for pixel in range(size):
        start, end = max(center - side / 2, pixel), min(center + side / 2, pixel + 1)
        if end > start:
            for p in range(size):
                hat = np.interp((start + end) / 2, np.arange(size) + 0.5, np.eye(size)[p])
                weights[p] += (end - start) / side * hat
    return weights


def dense_kernel(name, size, grid, sides):
    """[hd, wd, h, w]"""
    (h, w), (hd, wd) = size, grid
    if name == "pyramid":
        squares = [
            sides[0] * w * 2 ** (j / 2) for j in range(40) if 2 ** (j / 2) <= sides[-1] / sides[0] + 1e-6
        ]
        boxes = [(side, side, (2 * math.sqrt(2)) ** -j * side**2) for j, side in enumerate(squares)]
    else:
        boxes = [(h / hd, w / wd, 1.0)]
    kernel = np.zeros((hd, wd, h, w))
    for i, k, (high, wide, mass) in itertools.product(range(hd), range(wd), boxes):
        y, x = axis_window(h, (i + 0.5) * h / hd, high), axis_window(w, (k + 0.5) * w / wd, wide)
        kernel[i, k] += mass * np.outer(y, x)
    return torch.from_numpy(kernel / sum(mass for _, _, mass in boxes))


def reference_mean(kernel, features, logits, mask):
    weights = torch.where(kernel * mask > 1e-12, (kernel * mask).clamp(min=1e-300).log() + logits, -math.inf)
    weights = torch.softmax(weights.flatten(2), dim=-1).nan_to_num()
    return weights @ features.flatten(0, 1)
