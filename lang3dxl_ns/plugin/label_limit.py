"""Upper limit of word scores on a trained geometry: exact labels, lifted to Gaussians and rendered back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.evaluation.scores import Maps
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.rendering.gathering import Pixels, gather

Masks = Mapping[str, Bool[Array, "h w"]]


def label_limit(
    model: Lang3DXLModel, views: Iterable[tuple[Cameras, Masks]], categories: list[str]
) -> Callable[[Cameras], Maps]:
    """Returns a function from a view to its maps by category, at the size of the rendering.

    Each Gaussian gets the mean label of the pixels it contributes to, weighted by compositing
    weight, over all `views`; a category uses those with a label of it. model: in evaluation mode.
    """

    def probes():
        for camera, masks in views:
            size = int(camera.height.item()), int(camera.width.item())
            yield partial(model.composite, camera), Pixels.of([_labels(masks, categories, size)], size)

    lifted, _ = gather(model.num_points, probes(), 2 * len(categories), model.means.detach())
    labels, labeled = lifted.chunk(2, dim=1)
    shares = torch.where(labeled > 0, labels / labeled, 0.0)

    def maps(camera: Cameras) -> Maps:
        found = model.composite(camera, shares)
        return dict(zip(categories, found.permute(2, 0, 1), strict=True))

    return maps


def _labels(masks: Masks, categories: list[str], size: tuple[int, int]) -> Float[Tensor, "h w channels"]:
    """A channel per category with its label, and one per category that is 1 if it is labeled here."""
    labels, labeled = torch.zeros(2, len(categories), *size)
    for index, category in enumerate(categories):
        if category in masks:
            mask = torch.from_numpy(np.asarray(masks[category])).float()
            labels[index] = F.adaptive_avg_pool2d(mask[None], size)[0]
            labeled[index] = 1
    return torch.cat([labels, labeled]).permute(1, 2, 0)
