"""Upper limit of word scores on a trained geometry: exact labels, lifted to Gaussians and rendered back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.rendering import Splats, composite
from lang3dxl_ns.rendering.gathering import Pixels, gather
from lang3dxl_ns.scene.camera import Camera

Masks = Mapping[str, Bool[Array, "h w"]]


def label_limit(
    splats: Splats, views: Iterable[tuple[Camera, Masks]], categories: list[str]
) -> Callable[[Camera], Float[Tensor, "categories h w"]]:
    """Return a function from a view to its maps, in the order of the categories."""
    shares = lifted_labels(splats, views, categories)
    return lambda camera: composite(splats, camera, shares).permute(2, 0, 1)


def lifted_labels(
    splats: Splats, views: Iterable[tuple[Camera, Masks]], categories: list[str]
) -> Float[Tensor, "n categories"]:
    """Compute each Gaussian's mean label over the pixels that it contributes to, weighted by compositing
    weight, in all `views` that label the category. It is 0 for Gaussians that none of these views shows."""

    def probes():
        for camera, masks in views:
            size = camera.height, camera.width
            labels = Pixels.of([_labels(masks, categories, size)], size)
            yield partial(composite, splats, camera), labels

    lifted, _ = gather(len(splats), probes(), 2 * len(categories), splats.means)
    labels, labeled = lifted.chunk(2, dim=1)
    return torch.where(labeled > 0, labels / labeled, 0.0).to(splats.means)


def _labels(masks: Masks, categories: list[str], size: tuple[int, int]) -> Float[Tensor, "h w channels"]:
    """Stack a channel per category with its label, and one per category that is 1 if it is labeled here."""
    labels, labeled = torch.zeros(2, len(categories), *size)
    for index, category in enumerate(categories):
        if category in masks:
            mask = torch.from_numpy(np.asarray(masks[category])).float()
            labels[index] = F.adaptive_avg_pool2d(mask[None], size)[0]
            labeled[index] = 1
    return torch.cat([labels, labeled]).permute(1, 2, 0)
