"""Lifting of photo features onto the Gaussians of a trained model, without training on renderings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import deepcopy
from functools import partial

import torch
from nerfstudio.cameras.cameras import Cameras
from torch.nn import Parameter

from lang3dxl_ns.components.learn_codes import TargetView, learn_codes
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.preparation.handover import Batch

LONGER_SIDE = 1_600
"""Longer side in pixels to which larger photos are reduced for gathering: a CLIP crop covers hundreds of
pixels, and time and memory grow with their number."""


def learn_from_photos(
    model: Lang3DXLModel,
    photos: Iterable[tuple[Cameras, Batch]],
    advance: Callable[[], None] = lambda: None,
) -> None:
    """Give the model's Gaussians codes that represent the photos' targets; see `learn_codes`.

    Args:
        model: the model in training mode, so that it renders its photos as in training.
        photos: cameras and batches, with targets.
        advance: called `learning_steps` times as the decoder learns.
    """
    decoder, facts = model.semantic_field, model.facts
    assert decoder is not None and facts.clip_targets is not None
    views = (_view(model, camera, batch) for camera, batch in photos)
    codes = learn_codes(
        decoder, views, model.means.detach(), facts.clip_targets, facts.dense_targets, advance
    )
    if model.learns_from_renderings:
        with torch.no_grad():
            model.gauss_params["codes"].copy_(codes.nan_to_num(0.0))
    else:
        model.gauss_params["codes"] = Parameter(codes.to(model.device), requires_grad=False)


def _view(model: Lang3DXLModel, camera: Cameras, batch: Batch) -> TargetView:
    camera = working_camera(camera)
    return TargetView(
        partial(model.composite, camera),
        (int(camera.height.item()), int(camera.width.item())),
        batch["clip_target"],
        batch.get("dense_target"),
        batch["mask"][..., 0] if "mask" in batch else None,
    )


def working_camera(camera: Cameras) -> Cameras:
    """Return the camera, with an image plane of at most `LONGER_SIDE` pixels."""
    longer = int(torch.maximum(camera.width, camera.height).max())
    if longer > LONGER_SIDE:
        camera = deepcopy(camera)
        camera.rescale_output_resolution(LONGER_SIDE / longer)
    return camera
