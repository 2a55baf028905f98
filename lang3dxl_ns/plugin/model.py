"""Lang3D-XL's model: splatfacto's Gaussians with semantic codes, and the field that decodes them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.model_components.lib_bilagrid import color_correct
from nerfstudio.utils.colors import get_color
from pytorch_msssim import SSIM
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.common.image import fitted_size, resize_nearest
from lang3dxl_ns.components.losses import resize
from lang3dxl_ns.evaluation.photo_metrics import Lpips, feature_metrics, match, psnr, reached
from lang3dxl_ns.plugin.cameras import photo_camera
from lang3dxl_ns.plugin.model_config import ModelSettings
from lang3dxl_ns.plugin.rendering_model import RenderingModel
from lang3dxl_ns.plugin.splatfacto import SplatfactoModel
from lang3dxl_ns.preparation.targets import Batch, foreground
from lang3dxl_ns.training.learn_codes import forget_words, learn_words
from lang3dxl_ns.training.state import Training
from lang3dxl_ns.training.step import finish, losses


@dataclass
class Lang3DXLModelConfig(ModelSettings):
    """Settings of the model."""

    _target: type = field(default_factory=lambda: Lang3DXLModel)


class Lang3DXLModel(RenderingModel):
    """Gaussians with colors and semantic codes; without targets (clip = none) there are no semantic parts."""

    def populate_modules(self) -> None:
        """Build Gaussians, strategy, components and metrics (on the CPU; the pipeline moves them)."""
        self.config.fit_to_run(self.config.total_steps)
        self.run = Training.begin(self.config, self.facts, self.seed_points)
        self.gauss_params = self.run.gaussians
        self.adopt_parts()
        self.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
        self.lpips = Lpips()
        self.crop_box = None
        self.background_color = get_color(
            "black" if self.config.background_color == "random" else self.config.background_color
        )

    # ── training ────────────────────────────────────────────────────────────────────────────────────

    def step_post_backward(self, step: int) -> None:
        """Finish an iteration."""
        finish(self.run)

    def learn_from_photos(self, photos: Iterable[tuple[Cameras, Batch]], count: int) -> None:
        """Give the Gaussians codes that represent the targets of this number of photos (cameras and batches);
        see `learn_codes`."""
        learn_words(self.run, ((photo_camera(camera), batch) for camera, batch in photos), count)

    def forget_gathered_codes(self) -> None:
        """Remove codes that were gathered for a question in training, since the Gaussians still change."""
        forget_words(self.run)

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """Return the optimizer groups: one per Gaussian property, and those of the parts."""
        return self.run.groups()

    # ── losses and metrics ──────────────────────────────────────────────────────────────────────────

    def get_loss_dict(
        self, outputs: dict, batch: Batch, metrics_dict: dict | None = None
    ) -> dict[str, Tensor]:
        """Compute the color loss and, if there are semantics, the semantic losses, all already weighted."""
        return losses(self.run, outputs["rgb"], outputs.get("codes"), batch)

    def get_metrics_dict(self, outputs: dict, batch: Batch) -> dict[str, Tensor]:
        """Compute numbers for the log: PSNR of the step's photo, and the number of Gaussians."""
        found = psnr(outputs["rgb"].detach(), self.get_gt_img(batch["image"]))
        metrics = {"psnr": found, "gaussian_count": torch.tensor(self.num_points)}
        cameras = self.run.parts.cameras
        return metrics if cameras is None else metrics | cameras.figures()

    @torch.no_grad()
    def get_image_metrics_and_images(  # type: ignore[override]
        self, outputs: dict, batch: Batch
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Evaluate a held-out photo: PSNR, SSIM, and LPIPS if its weights are available."""
        target, predicted = self.get_gt_img(batch["image"]), outputs["rgb"]
        metrics = self.image_metrics(predicted, target, foreground(batch))
        images = {"img": torch.cat([target, predicted], dim=1)}
        if "bottleneck" in outputs:
            images["bottleneck"] = outputs["bottleneck"]
        return metrics, images

    @torch.no_grad()
    def corrected_psnr(self, outputs: dict, batch: Batch) -> float:
        """Compute PSNR with matched colors, which takes seconds for a large photo; only `ns-eval` does."""
        photo = self.get_gt_img(batch["image"])
        pixels = reached(photo, foreground(batch))
        # Colors are matched on the CPU, whose solver also handles pictures of a single color.
        target, predicted = photo[pixels].cpu(), outputs["rgb"][pixels].cpu()
        return float(psnr(color_correct(predicted, target), target))

    @torch.no_grad()
    def image_metrics(
        self,
        predicted: Float[Tensor, "h w 3"],
        target: Float[Tensor, "h w 3"],
        mask: Bool[Tensor, "h w"] | None = None,
    ) -> dict[str, float]:
        """Compute `psnr` (dB), `ssim`, and `lpips` if its weights are available, where a photo with a mask
        reaches."""
        pixels = reached(target, mask)
        predicted = torch.where(pixels[..., None], predicted, target)
        chw = [image.permute(2, 0, 1)[None] for image in (target, predicted)]
        metrics = {"psnr": float(psnr(predicted[pixels], target[pixels])), "ssim": float(self.ssim(*chw))}
        perceptual = self.lpips(*chw)
        return metrics if perceptual is None else metrics | {"lpips": perceptual}

    @torch.no_grad()
    def feature_metrics(self, camera: Cameras, batch: Batch) -> dict[str, float]:
        """Measure agreement with a photo's targets, for the model and for the mean training feature."""
        if self.carried is None or "clip_target" not in batch:
            return {}
        assert self.config.decode_size is not None
        mask = foreground(batch)
        clip, dense, small_mask = self._feature_maps(camera, self.config.decode_size[1], mask)
        target = batch["clip_target"]
        predicted, weight = match(clip, target, batch["crop_sides"], small_mask)
        metrics = feature_metrics("clip", predicted, target, self.clip_mean, weight)
        if dense is not None and "dense_target" in batch:
            target = resize(batch["dense_target"], dense.shape[:2])
            metrics |= feature_metrics("dense", dense, target, self.dense_mean, small_mask)
        return metrics

    def _feature_maps(self, camera: Cameras, longer_side: int, mask: Tensor | None):
        """Compute features in a camera → clip [h, w, C], dense [h, w, D] or None, mask [h, w]. They are
        decoded before or after compositing, depending on the decoder."""
        decoder, carried = self.semantic_field, self.carried
        assert decoder is not None and carried is not None
        if not decoder.per_gaussian:
            codes = self.composite(camera, carried)
            codes = resize_nearest(codes, fitted_size(codes.shape, longer_side))
            clip, dense = decoder(codes)
            size = (codes.shape[0], codes.shape[1])
            return clip, dense, None if mask is None else resize_nearest(mask, size)
        # The last layer is linear, so hidden activations are composited and divided by coverage.
        known = carried.isfinite().all(1, keepdim=True)
        hidden = torch.where(known, decoder.hidden(torch.where(known, carried, 0.0)), 0.0)
        maps = self.composite(camera, torch.cat([hidden, known.to(hidden)], dim=1))
        size = fitted_size(maps.shape, longer_side)
        maps = resize_nearest(maps, size)
        clip, head = maps[..., :-1] / maps[..., -1:].clamp_min(1e-3), decoder.clip_head()
        small_mask = None if mask is None else resize_nearest(mask, size)
        return clip if head is None else F.linear(clip, *head), None, small_mask

    # ── checkpoints ─────────────────────────────────────────────────────────────────────────────────

    def load_state_dict(self, state: Mapping[str, Any], **kwargs):  # type: ignore[override]
        """Load a checkpoint of any number of Gaussians, with or without semantics."""
        self.run.match(state)
        self.adopt_parts()
        self.step = self.config.total_steps
        return super(SplatfactoModel, self).load_state_dict(state, **kwargs)
