"""A step of training, as in Lang3D-XL: render a photo's view, compare, and let the Gaussians multiply.

Who drives a run (`fit`, or nerfstudio's trainer) calls in every iteration `render`, `losses`, backward on the
losses' sum, an optimizer step, and `finish`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.common.image import fitted_size, resize_nearest
from lang3dxl_ns.components import losses as compared
from lang3dxl_ns.preparation.targets import Batch, foreground
from lang3dxl_ns.rendering import rasterize
from lang3dxl_ns.rendering.rasterize import at_fewer_pixels
from lang3dxl_ns.scene.camera import in_view
from lang3dxl_ns.training.gaussians import EVERY, activated, color_parameters, colors_seen, keep_in_bounds
from lang3dxl_ns.training.learning_rates import semantic_ramp
from lang3dxl_ns.training.state import PhotoCamera, Training

DECODE_SIZES = 5
"""Number of resolutions at which codes are rendered and decoded in training."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """What a step renders, with gradients."""

    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W 1"]
    background: Float[Tensor, "3"]
    codes: Float[Tensor, "h w d"] | None
    """Codes at the resolution that the step decodes; None while only colors are trained."""


def render(run: Training, view: PhotoCamera) -> Rendered:
    """Render a photo's view: its colors and, unless the run is still warming up, codes."""
    g, settings, parts = run.gaussians, run.settings, run.parts
    pose = run.pose(view)
    camera, pose, background = view.camera(pose), to_device(pose, run.device), run.background()
    gaussians = activated(g)
    colors = colors_seen(g, run.degree, pose[:, 3])
    if parts.sky is not None:
        gaussians, colors = parts.sky(gaussians, colors)
    in_photo = gaussians
    if parts.appearance is not None:
        vector = _look(run, view, pose)
        near = camera.detach().to(run.device)
        visible = in_view(near, gaussians.means, gaussians.scales).nonzero().squeeze(1)
        colors, in_photo = parts.appearance(gaussians, colors, vector, visible, run.step)
    how: dict[str, Any] = {"backend": run.backend, "antialiased": run.antialiased}
    photo = rasterize(in_photo.seen_from(camera), camera, colors, background, **how)
    if photo.info["means2d"].requires_grad:
        photo.info["means2d"].retain_grad()  # densification reads it
    run.seen = photo.info
    carried = run.carried if run.learns_from_renderings and run.warm_up_is_over else None
    if carried is None:
        return Rendered(photo.image.clamp(0.0, 1.0), photo.alpha, background, None)
    # Semantics belong to the scene, not to a photo, so they keep the scene's opacities.
    if settings.feature_gradient_to_geometry:
        gaussians = replace(gaussians, opacities=gaussians.opacities.detach())
    else:
        gaussians, camera = gaussians.mapped(Tensor.detach), camera.detach()
    # A photo has many times the pixels that are decoded. The same ellipses are drawn at these alone.
    size = fitted_size((camera.height, camera.width), decoded_side(run))
    small, eps2d = at_fewer_pixels(camera, *size)
    codes = rasterize(gaussians.seen_from(camera), small, carried, eps2d=eps2d, **how).image
    return Rendered(photo.image.clamp(0.0, 1.0), photo.alpha, background, codes)


def decoded_side(run: Training) -> int:
    """Return the longer side at which this iteration decodes: one of a few, since a GPU's libraries prepare
    for every new size, and the same after a resume."""
    assert run.settings.decode_size is not None
    smallest, largest = run.settings.decode_size
    generator = torch.Generator().manual_seed(run.step)
    place = int(torch.randint(DECODE_SIZES, (), generator=generator)) / (DECODE_SIZES - 1)
    return round(smallest + place * (largest - smallest))


def _look(run: Training, view: PhotoCamera, pose: Float[Tensor, "3 4"]) -> Float[Tensor, " v"]:
    """Return the training photo's appearance vector, or for other views the one that the rule chooses."""
    looks = run.parts.appearance
    assert looks is not None
    position, direction = pose[:, 3].detach(), -pose[:, 2].detach()
    if view.photo is None:
        return looks.vector_of_view(position, direction)
    name = run.facts.names[view.photo]
    looks.remember(name, position, direction)
    return looks.vector(name)


def losses(
    run: Training, rgb: Float[Tensor, "H W 3"], codes: Float[Tensor, "h w d"] | None, batch: Batch
) -> dict[str, Tensor]:
    """Compare what `render` returns with the photo and its targets: compute the color loss and, if there are
    codes, the semantic losses, all already weighted."""
    mask = foreground(batch)
    photo = to_device(batch["image"], run.device).float() / 255.0
    loss = {"rgb": compared.rgb_loss(rgb, photo, mask, run.settings.ssim_lambda)}
    if run.parts.cameras is not None:
        loss["camera_opt_regularizer"] = run.parts.cameras.penalty()
    if codes is not None and "clip_target" in batch:
        loss |= _semantic_losses(run, codes, batch, mask)
    return loss


def _semantic_losses(
    run: Training, codes: Float[Tensor, "h w d"], batch: Batch, mask: Bool[Tensor, "H W"] | None
) -> dict[str, Tensor]:
    c, semantics = run.settings, run.parts.semantics
    assert c.dense_weight is not None and semantics is not None
    ramp = semantic_ramp(run.step / c.total_steps, c.semantic_ramp)
    clip, dense = semantics.decoder(codes)
    small_mask = None if mask is None else resize_nearest(mask, (codes.shape[0], codes.shape[1]))
    wanted = batch["clip_target"], batch["crop_sides"]
    predicted, target, weight = semantics.downsampler.match(clip, *wanted, small_mask)
    # Cells with little foreground have a low weight.
    difference = compared.clip_loss(predicted, target, None if small_mask is None else weight)
    loss = {"clip": ramp * c.clip_weight * difference}
    if dense is not None and "dense_target" in batch:
        difference = compared.dense_loss(dense, batch["dense_target"])
        loss["dense"] = ramp * c.dense_weight * difference
    if "regions" in batch:
        labels = resize_nearest(batch["regions"], (clip.shape[0], clip.shape[1]))
        loss["regions"] = c.region_weight * compared.region_variance_loss(clip, labels, small_mask)
    own = semantics.decoder.own_losses(clip, dense)
    return loss | {name: ramp * value for name, value in own.items()}


def finish(run: Training) -> None:
    """Finish an iteration after its optimizer step: densify and prune (except after a skipped step), keep
    Gaussians in bounds, and write the sky's colors."""
    g, step, seen, run.seen = run.gaussians, run.step, run.seen, {}
    if step > 0 and run.step_is_sound:
        run.densification.after_backward(g, run.optimizers, run.statistics, step, seen)
    degree, still = run.settings.sh_degree, run.densification.still
    if step % EVERY == 0 or step + 1 == run.settings.total_steps:
        keep_in_bounds(g, *run.extent, still, degree)
    if run.parts.sky is not None:
        with torch.no_grad():
            g["features_dc"][:still] = color_parameters(run.parts.sky.colors, degree)
