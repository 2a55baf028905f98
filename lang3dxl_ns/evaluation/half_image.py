"""Half-image protocol: the look of an unseen photo is fitted on its left half, and its right half is scored.

Comparing the whole of an unseen photo mostly measures how well its lighting was guessed. NeRF in the Wild
(Martin-Brualla et al. 2021), WildGaussians and NerfBaselines therefore fit it on half of the photo.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.reports import synchronize
from lang3dxl_ns.components.appearance import AppearanceField, Look, render_in_look
from lang3dxl_ns.components.losses import rgb_loss
from lang3dxl_ns.evaluation.photo_metrics import ImageMetrics
from lang3dxl_ns.rendering import Splats, rasterize
from lang3dxl_ns.scene.camera import Camera, in_view

STEPS = 64
"""Number of steps of the fit."""
RATE = 0.1
"""Adam's initial learning rate, which decays to zero along a cosine."""
PROTOCOL = "half_…: each photo's look is fitted on its left half, and its right half is scored"


@dataclass(frozen=True)
class HalfImageProtocol:
    """Half-image protocol for photos of one scene, which is not changed."""

    splats: Splats
    field: AppearanceField
    """Appearance field that makes the looks."""
    metrics: ImageMetrics
    background: Float[Tensor, "3"]
    """Color behind the scene, 0…1."""
    ssim_weight: float
    """Weight of 1 − SSIM in the color loss, as in training."""

    @torch.no_grad()
    def measure(
        self, camera: Camera, photo: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None = None
    ) -> tuple[Float[Tensor, "h w 3"], dict[str, float]]:
        """Fit the look on a photo's left half (its foreground, given a mask), and score its right half.
        Return the rendering of the whole view in this look, and the figures: `half_psnr` (dB), `half_ssim`,
        `half_lpips` if its weights are available, and `fit_seconds`, the time of the fit. The camera has the
        photo's size; colors are 0…1."""
        middle = photo.shape[1] // 2
        start = perf_counter()
        vector = self.fit(camera, photo[:, :middle], None if mask is None else mask[:, :middle])
        synchronize()
        seconds = perf_counter() - start
        look = Look(self.field, vector)
        rendering = render_in_look(self.splats, camera, look, background=self.background).rgb
        right = None if mask is None else mask[:, middle:]
        scores = self.metrics(rendering[:, middle:], photo[:, middle:], right)
        return rendering, {f"half_{name}": value for name, value in scores.items()} | {"fit_seconds": seconds}

    def fit(
        self,
        camera: Camera,
        left: Float[Tensor, "h w 3"],
        mask: Bool[Tensor, "h w"] | None = None,
        steps: int = STEPS,
    ) -> Float[Tensor, " v"]:
        """Fit the appearance vector to a photo's leftmost columns, by training's color loss on the mask's
        foreground. It starts, and with 0 steps ends, at the vector of an unseen view."""
        camera = camera.to(self.splats.means.device)
        vector = self.field.of_view(camera).vector.clone().requires_grad_()
        view = Camera(camera.view_matrix, camera.intrinsics, left.shape[1], left.shape[0])
        splats = self.splats.select(in_view(view, self.splats.means, self.splats.scales))
        gaussians, colors = splats.gaussians, splats.colors(view.position)
        everything = torch.arange(len(splats), device=colors.device)
        settings: dict[str, Any] = {"antialiased": splats.antialiased, "backend": splats.backend}
        optimizer = torch.optim.Adam([vector], lr=RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(steps, 1))
        with torch.enable_grad():
            for _ in range(steps):
                lit, shown = self.field(gaussians, colors, vector, everything)
                image = rasterize(shown.seen_from(view), view, lit, self.background, **settings).image
                loss = rgb_loss(image.clamp(0.0, 1.0), left, mask, self.ssim_weight)
                # Only the vector gets a gradient; the field's parameters get none.
                (vector.grad,) = torch.autograd.grad(loss, [vector])
                optimizer.step()
                schedule.step()
        return vector.detach()
