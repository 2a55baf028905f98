"""Lifting of photo features onto the Gaussians of a trained model, without training on renderings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.components.losses import resize
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.plugin.handover import Batch
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.rendering.gathering import gather


def learn_from_photos(
    model: Lang3DXLModel,
    photos: Iterable[tuple[Cameras, Batch]],
    advance: Callable[[], None] = lambda: None,
) -> None:
    """Gather the photos' target features onto the Gaussians, and let the encoder make codes of them.

    model: in training mode, so that it renders its photos as in training. photos: cameras and batches, with
    targets. advance: called as the encoder learns, `learning_steps` times.
    """
    encoder = model.semantic_field
    assert encoder is not None
    basis, width = None, len(model.clip_mean)
    if encoder.gathered_channels is not None and encoder.gathered_channels < width:
        targets = model.facts.clip_targets
        assert targets is not None
        basis, width = PrincipalBasis.of(targets(), encoder.gathered_channels), encoder.gathered_channels

    def views():
        for camera, batch in photos:
            size = batch["image"].shape[:2]
            mask = batch["mask"][..., 0] if "mask" in batch else None
            clip = batch["clip_target"]
            clip = clip if basis is None else basis.to(clip).coordinates(clip)
            pixels = pixel_features(clip, batch.get("dense_target"), mask, size)
            yield partial(model.composite, camera), pixels

    width += len(model.dense_mean)
    features, mass = gather(model.num_points, views(), width, model.means.detach())
    codes = encoder.learn_gaussians(features, mass, advance, basis)
    # Features that are many lie on the CPU, and those that are codes themselves come from there.
    model.gauss_params["codes"] = Parameter(codes.to(model.device), requires_grad=False)


def pixel_features(
    clip: Float[Tensor, "hd wd c"],
    dense: Float[Tensor, "t t d"] | None,
    mask: Tensor | None,
    size: tuple[int, int],
) -> Float[Tensor, "h w out"]:
    """A photo's targets at every pixel (bilinear), and a last channel of 1; all 0 outside the mask [H, W],
    and where a target isn't finite."""
    maps = [resize(target, size) for target in (clip, dense) if target is not None]
    pixels = torch.cat([*maps, torch.ones_like(maps[0][..., :1])], dim=-1)
    counts = pixels.isfinite().all(-1, keepdim=True)
    if mask is not None:
        counts &= resize(mask[..., None].to(pixels), size) >= 0.5
    return torch.where(counts, pixels, 0.0)
