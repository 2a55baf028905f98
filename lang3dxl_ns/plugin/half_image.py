"""Half-image protocol: the look of an unseen photo is fitted on its left half, and its right half is scored.

Nobody can know the light of a photo that training never saw, so a comparison of the whole photo measures the
guess of its light more than the scene. NeRF in the Wild (Martin-Brualla et al. 2021), WildGaussians and
NerfBaselines therefore let half of the photo tell its light.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from lang3dxl_ns.common.reports import synchronize
from lang3dxl_ns.components.looks import Look
from lang3dxl_ns.components.losses import rgb_loss
from lang3dxl_ns.plugin.cameras import to_rasterizer
from lang3dxl_ns.plugin.handover import Batch
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.rendering import Gaussians, rasterize
from lang3dxl_ns.scene.camera import Camera, in_view

STEPS = 64
"""Steps of the fit."""
RATE = 0.1
"""Adam's rate at its beginning; it falls to nothing as a cosine."""
PROTOCOL = "half_…: each photo's look is fitted on its left half, and its right half is scored"


@dataclass(frozen=True)
class HalfImage:
    """A photo in the look of its left half."""

    vector: Float[Tensor, " v"]
    """The fitted look."""
    rendering: Float[Tensor, "h w 3"]
    """Of the whole photo, in this look."""
    figures: dict[str, float]
    """Of the right half: `half_psnr` (dB), `half_ssim`, and `half_lpips` if its weights are available; and
    `fit_seconds`."""


@torch.no_grad()
def half_image(model: Lang3DXLModel, camera: Cameras, batch: Batch) -> HalfImage:
    """Fit the look on a photo's left half, and score the right one.

    model: with appearance, in evaluation mode. batch: the photo, as the data manager hands it over.
    """
    photo = model.get_gt_img(batch["image"])
    middle = photo.shape[1] // 2
    mask = batch["mask"][:, :middle, 0] if "mask" in batch else None
    start = perf_counter()
    vector = fit_look(model, camera, photo[:, :middle], mask)
    synchronize()
    seconds = perf_counter() - start
    assert model.appearance is not None
    rendering = model.seen(camera, Look(model.appearance, vector)).rgb
    scores = model.image_metrics(rendering[:, middle:], photo[:, middle:])
    figures = {f"half_{name}": value for name, value in scores.items()} | {"fit_seconds": seconds}
    return HalfImage(vector, rendering, figures)


def fit_look(
    model: Lang3DXLModel,
    camera: Cameras,
    left: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"] | None = None,
    steps: int = STEPS,
) -> Float[Tensor, " v"]:
    """The appearance vector that fits the left part of a photo, by the training's color loss; Gaussians and
    networks stay as they are. It begins as the vector of an unseen view.

    left: the leftmost w columns of the photo. mask: its foreground. steps: 0 for the vector to begin with.
    """
    field = model.appearance
    assert field is not None
    pose = camera.camera_to_worlds[0].to(model.device)
    vector = field.vector_of_view(pose[:, 3], -pose[:, 2]).detach().clone().requires_grad_()
    view = to_rasterizer(camera, camera.camera_to_worlds[0])
    view = Camera(view.view_matrix, view.intrinsics, left.shape[1], left.shape[0])
    gaussians, colors = _in_view(model, view, pose[:, 3])
    everything = torch.arange(len(colors), device=colors.device)
    background = model._get_background_color()
    antialiased = model.config.rasterize_mode == "antialiased"
    optimizer = torch.optim.Adam([vector], lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(steps, 1))
    with torch.enable_grad():
        for _ in range(steps):
            lit, shown = field(gaussians, colors, vector, everything)
            image = rasterize(
                shown, view, lit, background, antialiased=antialiased, backend=model.backend
            ).image
            loss = rgb_loss(image.clamp(0.0, 1.0), left, mask, model.config.ssim_lambda)
            # Of the vector alone: the model's parameters get no gradient.
            (vector.grad,) = torch.autograd.grad(loss, [vector])
            optimizer.step()
            schedule.step()
    return vector.detach()


@torch.no_grad()
def _in_view(
    model: Lang3DXLModel, view: Camera, position: Float[Tensor, "3"]
) -> tuple[Gaussians, Float[Tensor, "m 3"]]:
    """The Gaussians that a view may show, and their colors before any look."""
    gaussians = model.activated(model.gauss_params).detach()
    seen = in_view(view.to(model.device), gaussians.means, gaussians.scales)
    colors = model.colors_from(model.gauss_params, position)[seen]
    return Gaussians(*(values[seen] for values in vars(gaussians).values())), colors
