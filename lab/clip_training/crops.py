"""Crops of rendered views with soft labels: the share of each class in a crop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray as Array
from torch import Tensor

from lab.clip_training.captions import CLASS, CLASSES, UNLABELED
from lab.clip_training.views import COLOR, ELEMENT, MATERIAL, PART, LandmarkViews
from lab.landmark.labels import PARTS
from lab.landmark.materials import MATERIALS

SIDES = (26, 320)
"""Range of the crops' sides in pixels of a stored view."""
SAMPLES = 24
"""A crop's labels are sampled at SAMPLES × SAMPLES points."""
OUTSIDE = 255
"""Part of a sample outside the view."""

_CENTERED = 0.75  # share of crops around a pixel of a class drawn with these weights; the others are anywhere
_CENTER_WEIGHTS = {
    **{"sky": 0.7, "ground": 0.7, "wall": 1.3, "roof": 0.9, "column": 0.7, "clutter": 0.7, "house": 0.5},
    **{"window": 1.6, "portal": 1.4, "dome": 1.4, "tower": 1.7, "spire": 1.5, "minaret": 1.5},
    **{"tree": 0.5, "person": 0.4, "car": 0.4, "lamp": 0.3},
    **{"facade": 1.0, "road": 0.7, "balcony": 0.7, "fence": 0.5, "shop": 0.5, "sign": 0.3},
}
# Priority of classes in a crop that shows several: a dome before the sky behind it
_SALIENCY = {
    "sky": 0.35,
    "ground": 0.35,
    "wall": 0.5,
    "roof": 0.8,
    "column": 1.1,
    "portal": 1.2,
    "tower": 0.8,
} | {
    **{"spire": 1.1, "clutter": 0.8, "tree": 0.6, "person": 0.8, "car": 0.8, "house": 0.5, "lamp": 0.8},
    **{"facade": 0.5, "road": 0.4, "fence": 0.7, "shop": 0.7},
}
_HOST_SHARE = 0.25  # a window in a tower also counts a little as tower
_HOSTS = ("dome", "tower", "spire", "minaret")


@dataclass
class Crops:
    """Square crops with the labels of their sample points; a sample outside the view has part OUTSIDE."""

    images: UInt8[Tensor, "n 3 s s"]
    parts: UInt8[Array, "n g g"]
    elements: UInt8[Array, "n g g"]
    materials: UInt8[Array, "n g g"]
    families: Int[Array, " n"]

    @property
    def inside(self) -> Bool[Array, "n g g"]:
        return self.parts != OUTSIDE

    @property
    def classes(self) -> Int[Array, "n g g"]:
        """Class of every sample; meaningless for those outside."""
        return class_map(np.where(self.inside, self.parts, 0), self.elements).astype(int)


def join(parts: list[Crops]) -> Crops:
    """Several sets of crops as one."""
    fields = [
        [getattr(part, name) for part in parts] for name in ("parts", "elements", "materials", "families")
    ]
    return Crops(torch.cat([part.images for part in parts]), *(np.concatenate(arrays) for arrays in fields))


def class_map(parts: UInt8[Array, "..."], elements: UInt8[Array, "..."]) -> UInt8[Array, "..."]:
    """Class of every pixel: its element if it has one, else its part."""
    return np.where(elements > 0, len(PARTS) - 1 + elements, parts)


def draw_crops(
    landmarks: list[LandmarkViews],
    count: int,
    per_view: int,
    side: int,
    rng: np.random.Generator,
    sides: tuple[int, int] = SIDES,
) -> Crops:
    """`count` random crops, `per_view` from each view drawn, as `side` pixels; half of them are mirrored."""
    images, labels, families = [], [], []
    for _ in range(0, count, per_view):
        landmark = landmarks[rng.integers(len(landmarks))]
        view = landmark.views[rng.integers(len(landmark.views))]
        for corner, size in draw_windows(view, per_view, rng, sides):
            image, label = cut(view, corner, size, side)
            if rng.random() < 0.5:
                image, label = image.flip(-1), label[..., ::-1]
            images.append(image)
            labels.append(label)
            families.append(landmark.family)
    parts, elements, materials = np.stack(labels, axis=1)
    return Crops(torch.stack(images), parts, elements, materials, np.array(families))


def draw_windows(
    view: UInt8[Array, "6 h w"], count: int, rng: np.random.Generator, sides: tuple[int, int] = SIDES
) -> list[tuple[tuple[int, int], int]]:
    """Top-left corners (y, x) and sides of crops, partly outside the view, at pixels of varied classes."""
    height, width = view.shape[1:]
    stride = 5
    coarse = class_map(view[PART, ::stride, ::stride], view[ELEMENT, ::stride, ::stride])
    present = np.flatnonzero(np.bincount(coarse.ravel(), minlength=len(CLASSES)))
    present = present[present != UNLABELED]
    weights = np.array([_CENTER_WEIGHTS[CLASSES[k]] for k in present])
    windows = []
    for _ in range(count):
        side = round(float(np.exp(rng.uniform(*np.log(sides)))))
        if rng.random() < _CENTERED:
            class_ = rng.choice(present, p=weights / weights.sum())
            pixel = rng.choice(np.flatnonzero(coarse == class_))
            center = np.array(divmod(int(pixel), coarse.shape[1])) * stride + rng.normal(0, 0.1 * side, 2)
        else:
            center = rng.uniform((0, 0), (height, width))
        y, x = (min(max(float(c), 0), length) for c, length in zip(center, (height, width), strict=True))
        windows.append(((round(y - side / 2), round(x - side / 2)), side))
    return windows


def cut(
    view: UInt8[Array, "6 h w"], corner: tuple[int, int], size: int, side: int
) -> tuple[UInt8[Tensor, "3 side side"], UInt8[Array, "3 g g"]]:
    """The crop of `size` pixels at `corner` (y, x), as `side` pixels, and the labels of its samples."""
    height, width = view.shape[1:]
    top, left = corner
    inside = view[COLOR, max(top, 0) : top + size, max(left, 0) : left + size]
    crop = np.zeros((1, 3, size, size), np.uint8)
    y, x = max(-top, 0), max(-left, 0)
    crop[0, :, y : y + inside.shape[1], x : x + inside.shape[2]] = inside
    # the resize of the real pyramid
    image = F.interpolate(torch.from_numpy(crop), (side, side), mode="bicubic", antialias=True)[0]

    steps = np.floor((np.arange(SAMPLES) + 0.5) * size / SAMPLES).astype(int)
    rows, columns = top + steps, left + steps
    samples = view[PART : MATERIAL + 1, rows.clip(0, height - 1)[:, None], columns.clip(0, width - 1)]
    outside = ((rows < 0) | (rows >= height))[:, None] | (columns < 0) | (columns >= width)
    samples[:, outside] = np.array([[OUTSIDE], [0], [0]])
    return image, samples


def soft_labels(crops: Crops) -> Float[Array, "n k"]:
    """What each crop shows, as shares of the classes that sum to 1.

    Area weighted by a Gaussian around the center (sigma a fifth of the side) and by saliency, sharpened by
    squaring. Windows and portals on a tower, dome, spire or minaret also count a little for it.
    """
    weights = _center_weights()[None] * crops.inside
    shares = _count(crops.classes, weights, len(CLASSES) + 1)[:, :-1]  # the last label is UNLABELED
    hosts = np.isin(crops.parts, [CLASS[name] for name in _HOSTS]) & (crops.elements > 0)
    parts = np.where(crops.inside, crops.parts, 0)
    shares += _count(parts, _HOST_SHARE * weights * hosts, len(CLASSES) + 1)[:, :-1]
    shares *= np.array([_SALIENCY.get(name, 1.0) for name in CLASSES])
    shares = np.square(shares / shares.sum(1, keepdims=True).clip(1e-9))
    return shares / shares.sum(1, keepdims=True).clip(1e-9)


def label_shares(crops: Crops) -> Float[Array, "n l"]:
    """Area share of every label, UNLABELED last, in the part of each crop that is inside its view."""
    weights = _center_weights()[None] * crops.inside
    return _count(crops.classes, weights, len(CLASSES) + 1) / weights.sum((1, 2)).clip(1e-9)[:, None]


def patch_labels(crops: Crops, patches: int) -> Float[Array, "n p k"]:
    """Area shares of the classes in each of `patches`² patches, row by row; all zero for a patch outside."""

    def by_patch(samples):
        n, cell = len(samples), SAMPLES // patches
        return samples.reshape(n, patches, cell, patches, cell).swapaxes(2, 3).reshape(n * patches**2, -1)

    inside = by_patch(crops.inside).astype(np.float32)
    counts = _count(by_patch(crops.classes), inside, len(CLASSES) + 1)[:, :-1]
    shares = counts / np.maximum(inside.sum(1), 1)[:, None]
    return shares.reshape(len(crops.parts), patches**2, -1)


def main_materials(crops: Crops) -> Int[Array, "n k"]:
    """The most frequent material of each class in each crop; -1 where the class is absent, and in photos."""
    pairs = crops.classes * len(MATERIALS) + crops.materials
    counts = _count(pairs, crops.inside.astype(np.float32), (len(CLASSES) + 1) * len(MATERIALS))
    counts = counts.reshape(len(pairs), len(CLASSES) + 1, len(MATERIALS))[:, :-1]
    known = (counts.sum(-1) > 0) & (crops.families >= 0)[:, None]
    return np.where(known, counts.argmax(-1), -1)


def augment(
    images: UInt8[Tensor, "n 3 s s"], inside: Bool[Tensor, "n g g"], generator: torch.Generator
) -> Float[Tensor, "n 3 s s"]:
    """Crops in 0..1 with varied exposure, contrast, gamma, white balance, noise and sharpness; outside stays
    black."""

    def normal(deviation: float, *shape: int) -> Tensor:
        return deviation * torch.randn(len(images), *shape, generator=generator)

    x = images.float() / 255
    coarse = torch.rand(len(images), generator=generator) < 0.3  # a small crop of a photo is enlarged
    size = int(torch.randint(x.shape[-1] // 2, x.shape[-1], (), generator=generator))
    small = F.interpolate(x[coarse], (size, size), mode="bilinear", antialias=True)
    x[coarse] = F.interpolate(small, x.shape[-2:], mode="bicubic").clamp(0, 1)
    x = x * torch.exp(normal(0.2, 1, 1, 1) + normal(0.08, 3, 1, 1))
    x = x.clamp(0, 1) ** torch.exp(normal(0.15, 1, 1, 1))
    mean = x.mean((1, 2, 3), keepdim=True)
    x = mean + (x - mean) * torch.exp(normal(0.2, 1, 1, 1))
    gray = torch.rand(len(images), 1, 1, 1, generator=generator) < 0.1
    x = torch.where(gray, x.mean(1, keepdim=True), x)
    x = x + normal(0.02, 1, 1, 1).abs() * normal(1.0, *x.shape[1:])
    return x.clamp(0, 1) * F.interpolate(inside[:, None].float(), x.shape[-2:])


def _center_weights() -> Float[Array, "g g"]:
    offset = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    line = np.exp(-0.5 * (offset / 0.2) ** 2)
    return np.outer(line, line)


def _count(labels: Int[Array, "n ..."], weights: Float[Array, "n ..."], size: int) -> Float[Array, "n k"]:
    """Sum of the weights per label, for each of the n arrays."""
    rows = np.arange(len(labels)).reshape(-1, *[1] * (labels.ndim - 1)) * size
    flat = np.bincount((rows + labels).ravel(), weights.ravel(), minlength=len(labels) * size)
    return flat.reshape(len(labels), size)
