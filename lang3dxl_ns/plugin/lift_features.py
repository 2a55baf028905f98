"""Lifting of photo features onto the Gaussians of a trained model, without training on renderings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import deepcopy
from functools import partial

import torch
from nerfstudio.cameras.cameras import Cameras
from torch.nn import Parameter

from lang3dxl_ns.components.learn_codes import TargetView, learn_codes
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.preparation.handover import Batch
from lang3dxl_ns.rendering.gathering import Pixels, gather

LONGER_SIDE = 1_600
"""Pixels of the longer side at which larger photos are gathered: a CLIP crop covers hundreds of pixels, and
time and memory grow with their number."""
REACH = 3.0
"""Codes that start from gathered features lie within this many standard deviations."""


def learn_from_photos(
    model: Lang3DXLModel,
    photos: Iterable[tuple[Cameras, Batch]],
    advance: Callable[[], None] = lambda: None,
) -> None:
    """Give the model's Gaussians codes of the photos' targets; see `learn_codes`.

    model: in training mode, so that it renders its photos as in training. photos: cameras and batches, with
    targets. advance: called as the decoder learns, `learning_steps` times.
    """
    decoder, facts = model.semantic_field, model.facts
    assert decoder is not None and facts.clip_targets is not None
    views = (_view(model, camera, batch) for camera, batch in photos)
    codes = learn_codes(
        decoder, views, model.means.detach(), facts.clip_targets, facts.dense_targets, advance
    )
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


@torch.no_grad()
def start_codes(model: Lang3DXLModel, photos: Iterable[tuple[Cameras, Batch]]) -> None:
    """Let the Gaussians' codes differ as the features of what they show: set them to the first principal
    components of the photos' CLIP targets, gathered onto the present Gaussians, each divided by its
    deviation. Gaussians visible in no photo keep their codes.

    model: in training mode, one whose codes are learned from renderings. photos: cameras and batches, with
    targets.
    """
    codes, targets = model.gauss_params["codes"], model.facts.clip_targets
    assert targets is not None
    basis = PrincipalBasis.of(targets(), codes.shape[1])

    def views():
        for camera, batch in photos:
            camera, clip = working_camera(camera), batch["clip_target"]
            size = int(camera.height.item()), int(camera.width.item())
            mask = batch["mask"][..., 0] if "mask" in batch else None
            yield partial(model.composite, camera), Pixels.of([basis.to(clip).coordinates(clip)], size, mask)

    places, mass = gather(model.num_points, views(), codes.shape[1], model.means.detach())
    seen = (mass > 0).to(codes.device)
    places = places.to(codes)[seen]
    if len(places) > 1:
        codes[seen] = (places / places.std(0).clamp_min(1e-12)).clamp(-REACH, REACH)


def working_camera(camera: Cameras) -> Cameras:
    """The camera, with an image plane of at most `LONGER_SIDE` pixels."""
    longer = int(torch.maximum(camera.width, camera.height).max())
    if longer > LONGER_SIDE:
        camera = deepcopy(camera)
        camera.rescale_output_resolution(LONGER_SIDE / longer)
    return camera
