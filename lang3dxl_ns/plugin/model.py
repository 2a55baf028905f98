"""Lang3D-XL's model: splatfacto's Gaussians with semantic codes, and the field that decodes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isqrt
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.model_components.lib_bilagrid import color_correct
from nerfstudio.utils.colors import get_color
from nerfstudio.utils.rich_utils import CONSOLE
from pytorch_msssim import SSIM
from torch import Tensor, nn
from torch.nn import Parameter

from lang3dxl_ns.baselines.decoders import make_decoder
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.image import fitted_size, resize_nearest
from lang3dxl_ns.common.timing import part
from lang3dxl_ns.components import losses, schedules
from lang3dxl_ns.components.appearance import AppearanceField
from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler
from lang3dxl_ns.components.sky import OPACITY, Sky
from lang3dxl_ns.evaluation.feature_metrics import feature_metrics, match
from lang3dxl_ns.evaluation.image_metrics import Lpips, psnr
from lang3dxl_ns.plugin.handover import Batch
from lang3dxl_ns.plugin.initialization import (
    FIRST_OPACITY,
    color_parameters,
    initial_gaussians,
    seed_positions,
)
from lang3dxl_ns.plugin.model_config import ModelSettings, make_strategy
from lang3dxl_ns.plugin.rendering_model import RenderingModel
from lang3dxl_ns.plugin.splatfacto import SplatfactoModel
from lang3dxl_ns.preparation.targets import FeatureStatistics
from lang3dxl_ns.scene.geometry import center_and_radius

DECODE_SIZES = 5
"""Sizes at which code maps are decoded in training."""


@dataclass
class Lang3DXLModelConfig(ModelSettings):
    """Settings of the model."""

    _target: type = field(default_factory=lambda: Lang3DXLModel)


class Lang3DXLModel(RenderingModel):
    """Gaussians with colors and semantic codes; without targets (clip = none) it has no semantic parts."""

    downsampler: AttenuatedDownsampler | None
    clip_mean: Tensor
    dense_mean: Tensor

    def populate_modules(self) -> None:
        """Build Gaussians, components, metrics and strategy (on the CPU; the pipeline moves them)."""
        self.config.fit_to_run(self.config.total_steps)
        if not self._wants("view dependence", self.config.view_dependence):
            self.config.sh_degree = 0
        means, colors = seed_positions(self.config, self.seed_points)
        self.extent = center_and_radius(means)
        looks = self._wants("appearance", self.config.appearance.use)
        # Where photos differ in light a smooth sky costs words (docs/lab/short_and_long_runs.md).
        smooth = self.config.sky_gaussians if not looks else 0
        first = initial_gaussians(self.config, means, colors, OPACITY if smooth else FIRST_OPACITY)
        self.gauss_params = nn.ParameterDict(first)
        self.sky = Sky(first["means"].detach()[:smooth] - self.extent[0]) if smooth else None
        self._make_camera_optimizer(self._wants("camera optimizer", self.config.camera_optimization, False))
        self.semantic_field = self.downsampler = None
        statistics = self.facts.statistics
        if statistics is not None:
            clip, dense = statistics.clip, statistics.dense
            self._add_semantics(clip.mean, clip.mean[:0] if dense is None else dense.mean, statistics)
        self.appearance = None
        if looks:
            self.appearance = self._make_appearance()
        self.step = 0
        self.step_is_sound = True
        self.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
        self.lpips = Lpips()
        self.crop_box = None
        self.background_color = get_color(
            "black" if self.config.background_color == "random" else self.config.background_color
        )
        self.strategy = make_strategy(self.config)
        self.strategy.still = smooth
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)

    def _add_semantics(
        self,
        clip_mean: Float[Tensor, " c"],
        dense_mean: Float[Tensor, " d"],
        statistics: FeatureStatistics | None = None,
    ) -> None:
        """Build the feature decoder and the downsampler for this feature width; give every Gaussian a code.

        `statistics` of the targets, if available: not for a loaded model.
        """
        self.register_buffer("clip_mean", clip_mean)
        self.register_buffer("dense_mean", dense_mean)
        c = self.config
        self.semantic_field = make_decoder(
            c.decoder, c.semantic_field, len(clip_mean), len(dense_mean), *self.extent
        )
        if statistics is not None:
            clip, dense = statistics.clip.std, statistics.dense
            std = clip if dense is None else torch.cat([clip, dense.std])
            self.semantic_field.set_output_statistics(torch.cat([clip_mean, dense_mean]), std)
            with part("learn targets"):
                assert self.facts.clip_targets is not None
                self.semantic_field.learn_targets(self.facts.clip_targets)
        self.downsampler = AttenuatedDownsampler(c.downsampler, len(clip_mean))
        codes = self.semantic_field.initial_codes(self.num_points)
        if codes is not None:
            self.gauss_params["codes"] = Parameter(codes)

    def _wants(self, component: str, choice: str, unmeasured: bool = True) -> bool:
        """Whether to build an optional component; `auto`: by the scene's measured needs."""
        if choice == "auto":
            return self.facts.needs.get(component, unmeasured)
        return choice == "on"

    def _make_camera_optimizer(self, wanted: bool) -> None:
        settings = self.config.camera_optimizer
        if wanted and settings.mode == "off":
            settings.mode = "SO3xR3"
        self.camera_optimizer = settings.setup(num_cameras=self.num_train_data, device="cpu")

    def _make_appearance(self) -> AppearanceField:
        generator = torch.Generator().manual_seed(0)
        return AppearanceField(self.config.appearance, self.facts.names, *self.extent, generator=generator)

    # ── training ────────────────────────────────────────────────────────────────────────────────────

    def step_cb(self, optimizers, step: int) -> None:
        """Before an iteration: tell the components the fraction of the run done."""
        super().step_cb(optimizers, step)
        if self.semantic_field is not None:
            self.semantic_field.set_progress(step / self.config.total_steps)

    def step_post_backward(self, step: int) -> None:
        """After an iteration: densify and prune (except at step 0, where the strategy would reset opacities,
        and after a skipped step); write the sky's colors."""
        if step > 0 and self.step_is_sound:
            before = self.num_points
            self.strategy.step_post_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step
            )
            if self.num_points != before:
                CONSOLE.log(f"Step {step}: {before} → {self.num_points} Gaussians")
        if self.sky is not None:
            with torch.no_grad():
                colors = color_parameters(self.config, self.sky.colors)
                self.gauss_params["features_dc"][: len(self.sky)] = colors

    def forget_gathered_codes(self) -> None:
        """Remove codes that were gathered for a question in training: the Gaussians go on changing."""
        if not self.learns_from_renderings and "codes" in self.gauss_params:
            del self.gauss_params["codes"]

    def get_gaussian_param_groups(self) -> dict[str, list[Parameter]]:
        names = [n for n in self.gauss_params if n != "codes" or self.learns_from_renderings]
        return {name: [self.gauss_params[name]] for name in names}

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """Optimizer groups: one per Gaussian property, and those of the components present."""
        groups = super().get_param_groups()
        if self.semantic_field is not None and self.downsampler is not None:
            groups |= self.semantic_field.parameter_groups()
            if self.learns_from_renderings:
                groups["downsampler"] = list(self.downsampler.parameters())
        if self.sky is not None:
            groups["sky"] = [self.sky.harmonics]
        if self.appearance is not None:
            groups["appearance_vectors"] = [self.appearance.vectors]
            groups["appearance"] = self.appearance.network_parameters()
        return {name: parameters for name, parameters in groups.items() if parameters}

    # ── losses and metrics ──────────────────────────────────────────────────────────────────────────

    def get_loss_dict(
        self, outputs: dict, batch: Batch, metrics_dict: dict | None = None
    ) -> dict[str, Tensor]:
        """Color loss and, if there are semantics, the semantic losses (already weighted)."""
        mask = self._downscale_if_required(batch["mask"])[..., 0] if "mask" in batch else None
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
        ramp = schedules.semantic_ramp(self.step / c.total_steps, c.semantic_ramp)
        size = fitted_size(codes, self._random_size())
        clip, dense, small_mask = self._decode_small(codes, mask, size)
        with part("downsample"):
            predicted, target, weight = self._match(clip, batch, small_mask)
        with part("losses"):
            # Cells with little foreground have little weight.
            weight = None if small_mask is None else weight
            loss = {"clip": ramp * c.clip_weight * losses.clip_loss(predicted, target, weight)}
            if dense is not None and "dense_target" in batch:
                shown = small_mask if c.mask_dense else None
                difference = losses.dense_loss(dense, batch["dense_target"], shown, c.dense_compare)
                loss["dense"] = ramp * c.dense_weight * difference
            if "regions" in batch:
                labels = resize_nearest(batch["regions"][..., None].float(), clip.shape[:2])[..., 0].long()
                loss["regions"] = c.region_weight * losses.region_variance_loss(clip, labels, small_mask)
            assert self.semantic_field is not None
            own = self.semantic_field.own_losses(clip, dense)
        return loss | {name: ramp * value for name, value in own.items()}

    def _decode_small(self, codes: Float[Tensor, "H W 3"], mask: Tensor | None, size: tuple[int, int]):
        """Decode a map resized (nearest) to a given size → clip [h, w, C], dense, mask [h, w]."""
        small_mask = None if mask is None else resize_nearest(mask[..., None].float(), size)[..., 0]
        assert self.semantic_field is not None
        with part("decode"):
            clip, dense = self.semantic_field(resize_nearest(codes, size))
        return clip, dense, small_mask

    def _match(self, clip: Float[Tensor, "h w c"], batch: Batch, mask: Tensor | None):
        assert self.downsampler is not None
        return self.downsampler.match(clip, batch["clip_target"], batch["crop_sides"], mask)

    def _random_size(self) -> int:
        """Longer side to decode at in this iteration, one of a few, since a GPU's libraries prepare for every
        new size; the same after a resume."""
        assert self.config.decode_size is not None
        smallest, largest = self.config.decode_size
        generator = torch.Generator().manual_seed(self.step)
        place = int(torch.randint(DECODE_SIZES, (), generator=generator)) / (DECODE_SIZES - 1)
        return round(smallest + place * (largest - smallest))

    def get_metrics_dict(self, outputs: dict, batch: Batch) -> dict[str, Tensor]:
        """Numbers for the log: PSNR of the step's photo and the number of Gaussians."""
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
        """Held-out photo: PSNR, SSIM, and LPIPS if its weights are available."""
        target, predicted = self.get_gt_img(batch["image"]), outputs["rgb"]
        metrics = self.image_metrics(predicted, target)
        images = {"img": torch.cat([target, predicted], dim=1)}
        if "bottleneck" in outputs:
            images["bottleneck"] = outputs["bottleneck"]
        return metrics, images

    @torch.no_grad()
    def corrected_psnr(self, outputs: dict, batch: Batch) -> float:
        """PSNR with matched colors. It takes seconds for a large photo, so `ns-eval` alone measures it."""
        # Matched on the CPU, whose solver also handles pictures of a single color.
        target, predicted = self.get_gt_img(batch["image"]).cpu(), outputs["rgb"].cpu()
        return float(psnr(color_correct(predicted, target), target))

    @torch.no_grad()
    def image_metrics(
        self, predicted: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]
    ) -> dict[str, float]:
        """`psnr` (dB), `ssim`, and `lpips` if its weights are available."""
        chw = [image.permute(2, 0, 1)[None] for image in (target, predicted)]
        metrics = {"psnr": float(psnr(predicted, target)), "ssim": float(self.ssim(*chw))}
        perceptual = self.lpips(*chw)
        return metrics if perceptual is None else metrics | {"lpips": perceptual}

    @torch.no_grad()
    def feature_metrics(self, camera: Cameras, batch: Batch) -> dict[str, float]:
        """Agreement with a photo's targets, beside that of the mean training feature."""
        if self.carried is None or "clip_target" not in batch:
            return {}
        assert self.config.decode_size is not None
        mask = batch["mask"][..., 0] if "mask" in batch else None
        clip, dense, small_mask = self._feature_maps(camera, self.config.decode_size[1], mask)
        target = batch["clip_target"]
        predicted, weight = match(clip, target, batch["crop_sides"], small_mask)
        metrics = feature_metrics("clip", predicted, target, self.clip_mean, weight)
        if dense is not None and "dense_target" in batch:
            target = losses.resize(batch["dense_target"], dense.shape[:2])
            metrics |= feature_metrics("dense", dense, target, self.dense_mean, small_mask)
        return metrics

    def _feature_maps(self, camera: Cameras, longer_side: int, mask: Tensor | None):
        """Features in a camera → clip [h, w, C], dense [h, w, D] or None, mask [h, w]; decoded before or
        after compositing, depending on the decoder."""
        decoder, carried = self.semantic_field, self.carried
        assert decoder is not None and carried is not None
        if not decoder.per_gaussian:
            codes = self.composite(camera, carried)
            return self._decode_small(codes, mask, fitted_size(codes, longer_side))
        # The last layer is linear, so hidden activations are composited and divided by coverage.
        known = carried.isfinite().all(1, keepdim=True)
        hidden = torch.where(known, decoder.hidden(torch.where(known, carried, 0.0)), 0.0)
        maps = self.composite(camera, torch.cat([hidden, known.to(hidden)], dim=1))
        size = fitted_size(maps, longer_side)
        maps = resize_nearest(maps, size)
        clip = maps[..., :-1] / maps[..., -1:].clamp_min(1e-3)
        head = decoder.clip_head()
        if head is not None:
            clip = F.linear(clip, *head)
        small = None if mask is None else resize_nearest(mask[..., None].float(), size)[..., 0]
        return clip, None, small

    # ── checkpoints ─────────────────────────────────────────────────────────────────────────────────

    def load_state_dict(self, state: Mapping[str, Any], **kwargs):  # type: ignore[override]
        """Load a checkpoint of any number of Gaussians, with or without semantics.

        Parameters are resized in place: the optimizers hold them, and new ones would never be trained.
        """
        self._match_semantics(state)
        self._match_appearance(state)
        self._match_sky(state)
        self.config.sh_degree = isqrt(state["gauss_params.features_rest"].shape[1] + 1) - 1
        if "camera_optimizer.pose_adjustment" in state and self.config.camera_optimizer.mode == "off":
            self._make_camera_optimizer(wanted=True)
            self.to(self.device)
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

    def _match_appearance(self, state: Mapping[str, Any]) -> None:
        """`auto` follows the checkpoint; `on` and `off` must agree with it."""
        saved = "appearance.vectors" in state
        if saved == (self.appearance is not None):
            return
        if self.config.appearance.use != "auto":
            raise UserError(
                f"the checkpoint was trained {'with' if saved else 'without'} appearance: load it with "
                f"--pipeline.model.appearance.use auto, or train anew"
            )
        self.appearance = self._make_appearance().to(self.device) if saved else None

    def _match_sky(self, state: Mapping[str, Any]) -> None:
        """The checkpoint's sky, or none if it was trained like all Gaussians."""
        saved = state.get("sky.directions")
        if saved is None or self.sky is None or len(saved) != len(self.sky):
            self.sky = None if saved is None else Sky(torch.zeros_like(saved)).to(self.device)
            self.strategy.still = 0 if saved is None else len(saved)

    def _match_semantics(self, state: Mapping[str, Any]) -> None:
        """Build the components that the checkpoint has, or raise an error about the difference."""
        if "clip_mean" not in state:
            return
        saved = {"CLIP": state["clip_mean"], "dense": state["dense_mean"]}
        if self.semantic_field is None:
            self._add_semantics(*saved.values())
        assert self.semantic_field is not None
        if isinstance(self.semantic_field, CompressedField) and "gauss_params.codes" in state:
            self.semantic_field.fit_codes(state["gauss_params.codes"])
        if self.semantic_field.needs_lifting and "gauss_params.codes" in state:
            self.gauss_params["codes"] = Parameter(state["gauss_params.codes"].clone(), requires_grad=False)
        self.to(self.device)
        for kind, mean, prepared in zip(
            saved, saved.values(), (self.clip_mean, self.dense_mean), strict=True
        ):
            if len(mean) != len(prepared):
                raise UserError(
                    f"the checkpoint decodes to {kind} features of width {len(mean)}, but the prepared "
                    f"targets have {len(prepared)}: pass the --pipeline.datamanager.{kind.lower()} that the "
                    f"checkpoint was trained with, or train anew"
                )
