"""Lang3D-XL's model: splatfacto's Gaussians with semantic codes, and the field that decodes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.utils.colors import get_color
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.evaluation.photo_metrics import ImageMetrics, psnr
from lang3dxl_ns.plugin.model_config import ModelSettings
from lang3dxl_ns.plugin.rendering_model import RenderingModel
from lang3dxl_ns.plugin.splatfacto import SplatfactoModel
from lang3dxl_ns.preparation.targets import Batch, foreground
from lang3dxl_ns.training.learn_codes import forget_words
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
        self.image_metrics = ImageMetrics()
        self.crop_box = None
        self.background_color = get_color(
            "black" if self.config.background_color == "random" else self.config.background_color
        )

    # ── training ────────────────────────────────────────────────────────────────────────────────────

    def step_post_backward(self, step: int) -> None:
        """Finish an iteration."""
        finish(self.run)

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

    # ── checkpoints ─────────────────────────────────────────────────────────────────────────────────

    def load_state_dict(self, state: Mapping[str, Any], **kwargs):  # type: ignore[override]
        """Load a checkpoint of any number of Gaussians, with or without semantics."""
        self.run.match(state)
        self.adopt_parts()
        self.step = self.config.total_steps
        return super(SplatfactoModel, self).load_state_dict(state, **kwargs)
