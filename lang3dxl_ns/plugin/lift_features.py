"""Lifting of photo features onto the Gaussians of a trained model, without training on renderings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import deepcopy
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.components.grouping import DENSE_AXES, sharpen
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.plugin.handover import Batch
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.rendering.gathering import Pixels, gather

LONGER_SIDE = 1_600
"""Pixels of the longer side at which larger photos are gathered: a CLIP crop covers hundreds of pixels, and
time and memory grow with their number."""


def learn_from_photos(
    model: Lang3DXLModel,
    photos: Iterable[tuple[Cameras, Batch]],
    advance: Callable[[], None] = lambda: None,
) -> None:
    """Gather the photos' target features onto the Gaussians, sharpen them where there are dense features, and
    let the encoder make codes of them.

    model: in training mode, so that it renders its photos as in training. photos: cameras and batches, with
    targets. advance: called as the encoder learns, `learning_steps` times.
    """
    encoder, facts = model.semantic_field, model.facts
    assert encoder is not None
    basis = fine_basis = None
    width = channels = len(model.clip_mean)
    if encoder.gathered_channels is not None and encoder.gathered_channels < width:
        assert facts.clip_targets is not None
        width = channels = encoder.gathered_channels
        basis = PrincipalBasis.of(facts.clip_targets(), width)
    if facts.dense_targets is not None:
        fine_basis = PrincipalBasis.of(map(_unit, facts.dense_targets()), DENSE_AXES)
        channels += fine_basis.axes.shape[1]

    def views():
        for camera, batch in photos:
            camera = working_camera(camera)
            clip = batch["clip_target"]
            maps = [clip if basis is None else basis.to(clip).coordinates(clip)]
            if fine_basis is not None:
                maps.append(fine_basis.to(clip).coordinates(_unit(batch["dense_target"])))
            size = int(camera.height.item()), int(camera.width.item())
            mask = batch["mask"][..., 0] if "mask" in batch else None
            yield partial(model.composite, camera), Pixels.of(maps, size, mask)

    features, mass = gather(model.num_points, views(), channels, model.means.detach())
    if fine_basis is not None:
        features = sharpen(features[:, :width], features[:, width:], mass)
    codes = encoder.learn_gaussians(features, mass, advance, basis)
    # Features that are many lie on the CPU, and those that are codes themselves come from there.
    model.gauss_params["codes"] = Parameter(codes.to(model.device), requires_grad=False)


def working_camera(camera: Cameras) -> Cameras:
    """The camera, with an image plane of at most `LONGER_SIDE` pixels."""
    longer = int(torch.maximum(camera.width, camera.height).max())
    if longer > LONGER_SIDE:
        camera = deepcopy(camera)
        camera.rescale_output_resolution(LONGER_SIDE / longer)
    return camera


def _unit(dense: Float[Tensor, "t t d"]) -> Float[Tensor, "t t d"]:
    return F.normalize(dense.float(), dim=-1)
