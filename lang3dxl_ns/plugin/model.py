"""Lang3D-XL's model: splatfacto's Gaussians with semantic codes, and the field that decodes them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from math import isqrt
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.model_components.lib_bilagrid import color_correct
from nerfstudio.utils.colors import get_color
from nerfstudio.utils.rich_utils import CONSOLE
from pytorch_msssim import SSIM
from torch import Tensor, nn
from torch.nn import Parameter

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.image import fitted_size, resize_nearest
from lang3dxl_ns.common.reports import part
from lang3dxl_ns.components import losses
from lang3dxl_ns.evaluation.photo_metrics import Lpips, feature_metrics, match, psnr, reached
from lang3dxl_ns.plugin.model_config import ModelSettings, make_strategy
from lang3dxl_ns.plugin.optimizers import semantic_ramp
from lang3dxl_ns.plugin.optional_components import build_components, component_parameters, match_components
from lang3dxl_ns.plugin.rendering_model import RenderingModel
from lang3dxl_ns.plugin.splatfacto import SplatfactoModel
from lang3dxl_ns.preparation.targets import Batch, foreground
from lang3dxl_ns.training.initialization import (
    EVERY,
    FREE,
    center_and_radius,
    color_parameters,
    initial_gaussians,
    keep_in_bounds,
    seed_positions,
)
from lang3dxl_ns.training.learn_codes import TargetView, learn_codes

LONGER_SIDE = 1_600
"""Longer side in pixels to which larger photos are reduced for gathering: a CLIP crop covers hundreds of
pixels, and time and memory grow with their number."""


@dataclass
class Lang3DXLModelConfig(ModelSettings):
    """Settings of the model."""

    _target: type = field(default_factory=lambda: Lang3DXLModel)


class Lang3DXLModel(RenderingModel):
    """Gaussians with colors and semantic codes; without targets (clip = none) there are no semantic parts."""

    def populate_modules(self) -> None:
        """Build Gaussians, strategy, components and metrics (on the CPU; the pipeline moves them)."""
        c = self.config
        c.fit_to_run(c.total_steps)
        if not self.facts.wants("view dependence", c.view_dependence):
            c.sh_degree = 0
        points = None if c.random_init else self.seed_points
        means, colors = seed_positions(points, c.num_random, c.random_scale)
        self.extent = center_and_radius(means)
        first = initial_gaussians(means, colors, c.sky_gaussians, c.sh_degree)
        self.gauss_params = nn.ParameterDict(first)
        self.strategy = make_strategy(self.config)
        self.strategy.cameras, self.strategy.free = self.facts.positions, FREE * self.extent[1]
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)
        build_components(self)
        self.step = 0
        self.step_is_sound = True
        self.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
        self.lpips = Lpips()
        self.crop_box = None
        self.background_color = get_color(
            "black" if self.config.background_color == "random" else self.config.background_color
        )

    # ── training ────────────────────────────────────────────────────────────────────────────────────

    def step_post_backward(self, step: int) -> None:
        """Finish an iteration: densify and prune (except at step 0, where the strategy would reset opacities,
        and after a skipped step), keep Gaussians in bounds, and write the sky's colors."""
        if step > 0 and self.step_is_sound:
            before = self.num_points
            self.strategy.step_post_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step
            )
            if self.num_points != before:
                CONSOLE.log(f"Step {step}: {before} → {self.num_points} Gaussians")
        if step % EVERY == 0 or step + 1 == self.config.total_steps:
            keep_in_bounds(self.gauss_params, *self.extent, self.strategy.still, self.config.sh_degree)
        if self.sky is not None:
            with torch.no_grad():
                colors = color_parameters(self.sky.colors, self.config.sh_degree)
                self.gauss_params["features_dc"][: len(self.sky)] = colors

    def learn_from_photos(self, photos: Iterable[tuple[Cameras, Batch]], count: int) -> None:
        """Give the Gaussians codes that represent the targets of this number of photos (cameras and batches);
        see `learn_codes`."""
        decoder, facts = self.semantic_field, self.facts
        assert decoder is not None and facts.clip_targets is not None
        views, means = (self._target_view(*photo) for photo in photos), self.means.detach()
        # Codes that training goes on from start at what it compares with, which is not sharpened.
        dense = None if self.learns_from_renderings else facts.dense_targets
        codes = learn_codes(decoder, views, count, means, facts.clip_targets, dense)
        if self.learns_from_renderings:
            self.gauss_params["codes"].data.copy_(codes.nan_to_num(0.0))
        else:
            self.gauss_params["codes"] = Parameter(codes.to(self.device), requires_grad=False)

    def _target_view(self, camera: Cameras, batch: Batch) -> TargetView:
        longer = int(torch.maximum(camera.width, camera.height).max())
        if longer > LONGER_SIDE:
            camera = deepcopy(camera)
            camera.rescale_output_resolution(LONGER_SIDE / longer)
        return TargetView(
            partial(self.composite, camera),
            (int(camera.height.item()), int(camera.width.item())),
            batch["clip_target"],
            batch.get("dense_target"),
            foreground(batch),
        )

    def forget_gathered_codes(self) -> None:
        """Remove codes that were gathered for a question in training, since the Gaussians still change."""
        if not self.learns_from_renderings and "codes" in self.gauss_params:
            del self.gauss_params["codes"]

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """Return the optimizer groups: one per Gaussian property, and those of the components present."""
        names = [n for n in self.gauss_params if n != "codes" or self.learns_from_renderings]
        groups = {name: [self.gauss_params[name]] for name in names} | component_parameters(self)
        return {name: parameters for name, parameters in groups.items() if parameters}

    # ── losses and metrics ──────────────────────────────────────────────────────────────────────────

    def get_loss_dict(
        self, outputs: dict, batch: Batch, metrics_dict: dict | None = None
    ) -> dict[str, Tensor]:
        """Compute the color loss and, if there are semantics, the semantic losses, all already weighted."""
        mask = foreground(batch)
        with part("losses"):
            target = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
            loss = {"rgb": losses.rgb_loss(outputs["rgb"], target, mask, self.config.ssim_lambda)}
        if self.training:
            self.camera_optimizer.get_loss_dict(loss)
        if "codes" in outputs and "clip_target" in batch:
            loss |= self._semantic_losses(outputs["codes"], batch, mask)
        return loss

    def _semantic_losses(
        self, codes: Float[Tensor, "h w 3"], batch: Batch, mask: Tensor | None
    ) -> dict[str, Tensor]:
        c = self.config
        assert c.dense_weight is not None
        ramp = semantic_ramp(self.step / c.total_steps, c.semantic_ramp)
        clip, dense, small_mask = self._decode(codes, mask)
        assert self.semantic_field is not None and self.downsampler is not None
        with part("downsample"):
            predicted, target, weight = self.downsampler.match(
                clip, batch["clip_target"], batch["crop_sides"], small_mask
            )
        with part("losses"):
            # Cells with little foreground have a low weight.
            difference = losses.clip_loss(predicted, target, None if small_mask is None else weight)
            loss = {"clip": ramp * c.clip_weight * difference}
            if dense is not None and "dense_target" in batch:
                difference = losses.dense_loss(dense, batch["dense_target"])
                loss["dense"] = ramp * c.dense_weight * difference
            if "regions" in batch:
                labels = resize_nearest(batch["regions"], (clip.shape[0], clip.shape[1]))
                loss["regions"] = c.region_weight * losses.region_variance_loss(clip, labels, small_mask)
            own = self.semantic_field.own_losses(clip, dense)
        return loss | {name: ramp * value for name, value in own.items()}

    def _decode(self, codes: Float[Tensor, "h w 3"], mask: Tensor | None):
        """Decode a code map → clip [h, w, C], dense [h, w, D] or None, and the mask resized to [h, w]."""
        assert self.semantic_field is not None
        with part("decode"):
            clip, dense = self.semantic_field(codes)
        return clip, dense, None if mask is None else resize_nearest(mask, (codes.shape[0], codes.shape[1]))

    def get_metrics_dict(self, outputs: dict, batch: Batch) -> dict[str, Tensor]:
        """Compute numbers for the log: PSNR of the step's photo, and the number of Gaussians."""
        target = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
        metrics = {
            "psnr": psnr(outputs["rgb"].detach(), target),
            "gaussian_count": torch.tensor(self.num_points),
        }
        if self.camera_optimizer.config.mode != "off":
            change = self.camera_optimizer.pose_adjustment.detach()
            for name, sizes in {"translation": change[:, :3], "rotation": change[:, 3:].rad2deg()}.items():
                metrics[f"camera_opt_{name}_mean"] = sizes.norm(dim=1).mean()
                metrics[f"camera_opt_{name}_max"] = sizes.norm(dim=1).max()
        return metrics

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
            target = losses.resize(batch["dense_target"], dense.shape[:2])
            metrics |= feature_metrics("dense", dense, target, self.dense_mean, small_mask)
        return metrics

    def _feature_maps(self, camera: Cameras, longer_side: int, mask: Tensor | None):
        """Compute features in a camera → clip [h, w, C], dense [h, w, D] or None, mask [h, w]. They are
        decoded before or after compositing, depending on the decoder."""
        decoder, carried = self.semantic_field, self.carried
        assert decoder is not None and carried is not None
        if not decoder.per_gaussian:
            codes = self.composite(camera, carried)
            return self._decode(resize_nearest(codes, fitted_size(codes.shape, longer_side)), mask)
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
        """Load a checkpoint of any number of Gaussians, with or without semantics. Parameters are resized in
        place: the optimizers hold them, and new ones would never be trained."""
        match_components(self, state)
        self.config.sh_degree = isqrt(state["gauss_params.features_rest"].shape[1] + 1) - 1
        self.step = self.config.total_steps
        for name, parameter in self.gauss_params.items():
            saved = state[f"gauss_params.{name}"]
            inner = saved.shape[2:] if name == "features_rest" else saved.shape[1:]
            expected = parameter.shape[2:] if name == "features_rest" else parameter.shape[1:]
            if inner != expected or saved.shape[:1] != state["gauss_params.means"].shape[:1]:
                raise UserError(
                    f"the checkpoint's {name} have the shape {list(saved.shape)}: it is damaged, or from "
                    "another method; copy it again, or pass a run of ns-train lang3dxl"
                )
            parameter.data = torch.zeros(saved.shape, dtype=parameter.dtype, device=parameter.device)
        return super(SplatfactoModel, self).load_state_dict(state, **kwargs)
