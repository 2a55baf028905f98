"""Lang3D-XL's model: splatfacto's Gaussians with a semantic code each, and the field that decodes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import isqrt
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.model_components.lib_bilagrid import color_correct
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.utils.colors import get_color
from nerfstudio.utils.rich_utils import CONSOLE
from pytorch_msssim import SSIM
from torch import Tensor, nn
from torch.nn import Parameter

from lang3dxl_ns.answering import AnsweringModel
from lang3dxl_ns.baselines.encoders import make_encoder
from lang3dxl_ns.components import losses, schedules
from lang3dxl_ns.components.appearance import AppearanceField
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler
from lang3dxl_ns.components.encoder import SemanticEncoder
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.feature_metrics import feature_metrics
from lang3dxl_ns.evaluation.image_metrics import Lpips, psnr
from lang3dxl_ns.geometry import centre_and_radius, fitted_size, in_view, resize_nearest, view_matrix
from lang3dxl_ns.hash_levels import HashLevels
from lang3dxl_ns.initial_gaussians import initial_gaussians, seed_positions
from lang3dxl_ns.model_config import Lang3DXLModelConfig, make_strategy
from lang3dxl_ns.preparation.targets import FeatureStatistics
from lang3dxl_ns.rendering import Camera, Gaussians, Rendering, rasterize, spherical_harmonics
from lang3dxl_ns.rendering.gaussians import MAX_LOG_SCALE
from lang3dxl_ns.timing import part


class Lang3DXLModel(AnsweringModel):
    """Gaussians with colours and semantic codes; without targets to learn (clip = none) it has no
    semantic parts at all."""

    config: Lang3DXLModelConfig
    semantic_field: SemanticEncoder | None
    downsampler: AttenuatedDownsampler | None
    appearance: AppearanceField | None
    look: str | None
    """Photo in whose light views are shown; None: the appearance's rule for unseen views."""
    clip_mean: Tensor
    dense_mean: Tensor

    def populate_modules(self) -> None:
        """Build Gaussians, components, metrics and strategy (on the CPU; the pipeline moves them)."""
        self.config.fit_to_run(self.config.total_steps)
        if not self._wants("view dependence", self.config.view_dependence):
            self.config.sh_degree = 0
        means, colours = seed_positions(self.config, self.seed_points)
        self.extent = centre_and_radius(means)
        self.gauss_params = nn.ParameterDict(initial_gaussians(self.config, means, colours))
        self._make_camera_optimizer(self._wants("camera optimiser", self.config.camera_optimisation, False))
        self.semantic_field = self.downsampler = None
        statistics: FeatureStatistics | None = self.kwargs["metadata"].get("feature_statistics")
        if statistics is not None:
            clip, dense = statistics.clip, statistics.dense
            self._add_semantics(clip.mean, clip.mean[:0] if dense is None else dense.mean, statistics)
        self.look = None
        self.hash_levels = HashLevels()
        self.appearance = None
        if self._wants("appearance", self.config.appearance.use):
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
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)

    def _add_semantics(
        self,
        clip_mean: Float[Tensor, " c"],
        dense_mean: Float[Tensor, " d"],
        statistics: FeatureStatistics | None = None,
    ) -> None:
        """Build the encoder and the downsampler for features of this width, and give every Gaussian a code.

        `statistics` of the targets, where these are at hand: not for a model that is loaded.
        """
        self.register_buffer("clip_mean", clip_mean)
        self.register_buffer("dense_mean", dense_mean)
        c = self.config
        self.semantic_field = make_encoder(
            c.encoder, c.semantic_field, len(clip_mean), len(dense_mean), *self.extent
        )
        if statistics is not None:
            clip, dense = statistics.clip.std, statistics.dense
            std = clip if dense is None else torch.cat([clip, dense.std])
            self.semantic_field.set_output_statistics(torch.cat([clip_mean, dense_mean]), std)
            with part("learn targets"):
                self.semantic_field.learn_targets(self.kwargs["metadata"]["clip_targets"])
        self.downsampler = AttenuatedDownsampler(c.downsampler, len(clip_mean))
        codes = self.semantic_field.initial_codes(self.num_points)
        if codes is not None:
            self.gauss_params["codes"] = Parameter(codes)

    def _wants(self, component: str, choice: str, unmeasured: bool = True) -> bool:
        """Whether to build an optional component; `auto`: if the scene's measured needs say so."""
        if choice == "auto":
            return (self.kwargs["metadata"].get("needs") or {}).get(component, unmeasured)
        return choice == "on"

    def _make_camera_optimizer(self, wanted: bool) -> None:
        settings = self.config.camera_optimizer
        if wanted and settings.mode == "off":
            settings.mode = "SO3xR3"
        self.camera_optimizer = settings.setup(num_cameras=self.num_train_data, device="cpu")

    def _make_appearance(self) -> AppearanceField:
        names = [photo.name for photo in self.kwargs["metadata"].get("photos", ())]
        generator = torch.Generator().manual_seed(0)
        return AppearanceField(self.config.appearance, names, *self.extent, generator=generator)

    # ── training ────────────────────────────────────────────────────────────────────────────────────

    def step_cb(self, optimizers, step: int) -> None:
        """Before an iteration: tell the components how far the run is."""
        super().step_cb(optimizers, step)
        if self.semantic_field is not None:
            self.semantic_field.set_progress(step / self.config.total_steps)
            if step == self.config.total_steps // 2:
                self.hash_levels.decide(self.semantic_field, self.optimizers)
        if self.config.freeze_geometry_after_warm_up and self._warm_up_is_over:
            for name, parameter in self.gauss_params.items():
                # Densification wraps tensors anew, so this is said before every iteration.
                parameter.requires_grad_(name == "codes")

    def step_post_backward(self, step: int) -> None:
        """After an iteration: densify and prune (not at step 0, where the strategy would reset opacities,
        and not after a step that was skipped)."""
        if step > 0 and self.means.requires_grad and self.step_is_sound:
            before = self.num_points
            super().step_post_backward(step)
            if self.num_points != before:
                CONSOLE.log(f"Step {step}: {before} → {self.num_points} Gaussians")

    def get_gaussian_param_groups(self) -> dict[str, list[Parameter]]:
        return {name: [parameter] for name, parameter in self.gauss_params.items()}

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """Optimiser groups: one per Gaussian property, and those of the components that exist."""
        groups = super().get_param_groups()
        if self.semantic_field is not None and self.downsampler is not None:
            groups |= self.semantic_field.parameter_groups()
            groups["downsampler"] = list(self.downsampler.parameters())
        if self.appearance is not None:
            groups["appearance_vectors"] = [self.appearance.vectors]
            groups["appearance"] = self.appearance.network_parameters()
        return {name: parameters for name, parameters in groups.items() if parameters}

    @property
    def _warm_up_is_over(self) -> bool:
        return self.step >= self.config.warm_up * self.config.total_steps

    # ── rendering ───────────────────────────────────────────────────────────────────────────────────

    @property
    def codes(self) -> Float[Tensor, "n code"]:
        """Semantic code of every Gaussian."""
        return self.gauss_params["codes"]

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:  # type: ignore[override]
        """Render a camera: `rgb`, `accumulation`, `background`; in training `codes` [H, W, 3]; otherwise also
        `depth` and `bottleneck`, the codes as a picture in [0, 1]."""
        keep = None
        if self.crop_box is not None and not self.training:
            keep = self.crop_box.within(self.means).squeeze(-1)
            if not keep.any():
                size = int(camera.width.item()), int(camera.height.item())
                return self.get_empty_outputs(*size, self.background_color.to(self.device))  # type: ignore[return-value]
        with part("render"):
            rendering, background = self._render(camera, keep)
        self.info = rendering.info
        if self.training and self.means.requires_grad:
            self.strategy.step_pre_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step, self.info
            )
        outputs = {
            "rgb": rendering.image.clamp(0.0, 1.0),
            "accumulation": rendering.alpha,
            "background": background if self.training else background.expand_as(rendering.image),
        }
        if rendering.depth is not None:
            far = rendering.depth.detach().max()
            outputs["depth"] = torch.where(rendering.alpha > 0, rendering.depth, far)
        if rendering.features is not None:
            codes = rendering.features
            if self.config.divide_codes_by_alpha:
                codes = codes / rendering.alpha.detach().clamp_min(1e-3)
            if self.training:
                outputs["codes"] = codes
            else:
                # Kept aside for the metrics: viewers show every output, and would show this one raw.
                self.rendered_codes = codes
                assert self.semantic_field is not None
                outputs["bottleneck"] = self.semantic_field.picture(codes) * rendering.alpha
        return outputs

    def _render(self, camera: Cameras, keep: Tensor | None) -> tuple[Rendering, Float[Tensor, "3"]]:
        g = {name: p if keep is None else p[keep] for name, p in self.gauss_params.items()}
        pose = self.camera_optimizer.apply_to_camera(camera) if self.training else camera.camera_to_worlds
        downscale = self._get_downscale_factor()
        camera.rescale_output_resolution(1 / downscale)
        view = Camera(
            view_matrix=view_matrix(pose[0].to(self.device)),
            intrinsics=camera.get_intrinsics_matrices()[0].to(self.device),
            width=int(camera.width.item()),
            height=int(camera.height.item()),
        )
        camera.rescale_output_resolution(downscale)
        self.last_size = (view.height, view.width)
        background = self._get_background_color()
        scales = g["scales"].clamp_max(MAX_LOG_SCALE).exp()
        gaussians = Gaussians(g["means"], g["quats"], scales, g["opacities"].sigmoid().squeeze(-1))
        colours, in_photo = self._colours(g, pose[0, :, 3].to(self.device)), gaussians
        if self.appearance is not None:
            vector = self._light(camera, pose[0].to(self.device))
            visible = in_view(view, gaussians.means, gaussians.scales).nonzero().squeeze(1)
            seed = self.step if self.training else None
            with part("appearance"):
                colours, in_photo = self.appearance(gaussians, colours, vector, visible, seed)
        settings: dict[str, Any] = {
            "antialiased": self.config.rasterize_mode == "antialiased",
            "absgrad": self.strategy.absgrad and self.training,
        }
        carried = None
        if self.semantic_field is not None and self._warm_up_is_over:
            carried = self.semantic_field.carried(g)
        rendering = rasterize(
            gaussians,
            view,
            colours,
            background,
            features=carried,
            detach_features=not self.config.feature_gradient_to_geometry,
            render_depth=not self.training or self.config.output_depth_during_training,
            **settings,
        )
        if in_photo is not gaussians:
            # Semantics, coverage and depth are of the scene, not of a photo: they keep its opacities.
            photo = rasterize(in_photo, view, colours, background, **settings)
            rendering = replace(rendering, image=photo.image, info=photo.info)
        return rendering, background

    def _light(self, camera: Cameras, pose: Float[Tensor, "3 4"]) -> Float[Tensor, " v"]:
        """Vector of the training photo, of the chosen look, or by the rule for other views."""
        assert self.appearance is not None
        position, direction = pose[:, 3].detach(), -pose[:, 2].detach()
        if self.training and camera.metadata and "cam_idx" in camera.metadata:
            name = self.kwargs["metadata"]["photos"][camera.metadata["cam_idx"]].name
            self.appearance.remember(name, position, direction)
            return self.appearance.vector(name)
        if self.look is not None:
            return self.appearance.vector(self.look)
        return self.appearance.vector_of_view(position, direction)

    def _colours(self, g: Mapping[str, Tensor], camera_centre: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        """Colours seen from a point; the degree of the harmonics rises by one every 1,000 iterations, in
        runs of under 10,000 every tenth of the run. At degree 0 colours are logits, as in splatfacto."""
        if self.config.sh_degree == 0:
            return torch.sigmoid(g["features_dc"])
        interval = max(min(self.config.sh_degree_interval, self.config.total_steps // 10), 1)
        degree = min(self.step // interval, self.config.sh_degree)
        directions = g["means"].detach() - camera_centre
        coefficients = torch.cat((g["features_dc"][:, None], g["features_rest"]), dim=1)
        return (spherical_harmonics(degree, directions, coefficients) + 0.5).clamp_min(0.0)

    # ── losses and metrics ──────────────────────────────────────────────────────────────────────────

    def get_loss_dict(
        self, outputs: dict, batch: dict, metrics_dict: dict | None = None
    ) -> dict[str, Tensor]:
        """Colour loss and, where there is something to learn, the semantic losses (already weighted)."""
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
        self, codes: Float[Tensor, "h w 3"], batch: dict, mask: Tensor | None
    ) -> dict[str, Tensor]:
        c = self.config
        assert c.dense_weight is not None
        ramp = schedules.semantic_ramp(self.step / c.total_steps)
        size = fitted_size(codes, self._random_size())
        if c.hash_levels == "auto" and 0.4 <= self.step / c.total_steps < 0.5 and self.semantic_field:
            self.hash_levels.watch(self.semantic_field, resize_nearest(codes, size))
        clip, dense, small_mask = self._decode_small(codes, mask, size)
        with part("downsample"):
            predicted, target, weight = self._match(clip, batch, small_mask)
        with part("losses"):
            # Cells that see little of the foreground say little about it.
            weight = None if small_mask is None else weight
            loss = {"clip": ramp * c.clip_weight * losses.clip_loss(predicted, target, weight)}
            if dense is not None and "dense_target" in batch:
                difference = losses.dense_loss(dense, batch["dense_target"], small_mask)
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

    def _match(self, clip: Float[Tensor, "h w c"], batch: dict, mask: Tensor | None):
        assert self.downsampler is not None
        return self.downsampler.match(clip, batch["clip_target"], batch["crop_sides"], mask)

    def _random_size(self) -> int:
        """Longer side to decode at in this iteration; the same again after a resume."""
        assert self.config.decode_size is not None
        smallest, largest = self.config.decode_size
        generator = torch.Generator().manual_seed(self.step)
        return int(torch.randint(smallest, largest + 1, (), generator=generator))

    def get_metrics_dict(self, outputs: dict, batch: dict) -> dict[str, Tensor]:
        """Numbers for the log: PSNR of the step's photo and the number of Gaussians."""
        target = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
        metrics = {
            "psnr": psnr(outputs["rgb"].detach(), target),
            "gaussian_count": torch.tensor(self.num_points),
        }
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    @torch.no_grad()
    def get_image_metrics_and_images(
        self, outputs: dict, batch: dict
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Held-out photo: PSNR (`cc_psnr`: once its colours are matched), SSIM, LPIPS where its weights are
        at hand, and feature metrics."""
        target = self.get_gt_img(batch["image"])
        predicted = outputs["rgb"]
        chw = [image.permute(2, 0, 1)[None] for image in (target, predicted)]
        # Corrected on the CPU, whose solver also takes pictures of a single colour.
        corrected = color_correct(predicted.cpu(), target.cpu())
        metrics = {
            "psnr": float(psnr(predicted, target)),
            "cc_psnr": float(psnr(corrected, target.cpu())),
            "ssim": float(self.ssim(*chw)),
        }
        perceptual = self.lpips(*chw)
        if perceptual is not None:
            metrics["lpips"] = perceptual
        images = {"img": torch.cat([target, predicted], dim=1)}
        if "bottleneck" in outputs:
            images["bottleneck"] = outputs["bottleneck"]
            if "clip_target" in batch:
                metrics |= self._feature_metrics(batch)
        return metrics, images

    def _feature_metrics(self, batch: dict) -> dict[str, float]:
        """Agreement with the held-out photo's targets, beside that of the mean feature of training."""
        assert self.semantic_field is not None and self.config.decode_size is not None
        mask = batch["mask"][..., 0] if "mask" in batch else None
        size = fitted_size(self.rendered_codes, self.config.decode_size[1])
        clip, dense, small_mask = self._decode_small(self.rendered_codes, mask, size)
        predicted, target, weight = self._match(clip, batch, small_mask)
        metrics = feature_metrics("clip", predicted, target, self.clip_mean, weight)
        if dense is not None and "dense_target" in batch:
            target = losses.resize(batch["dense_target"], dense.shape[:2])
            metrics |= feature_metrics("dense", dense, target, self.dense_mean, small_mask)
        return metrics

    # ── checkpoints ─────────────────────────────────────────────────────────────────────────────────

    def load_state_dict(self, state: Mapping[str, Any], **kwargs):  # type: ignore[override]
        """Load a checkpoint of any number of Gaussians, with or without semantics.

        Parameters are resized in place: the optimisers hold them, and new ones would never be trained.
        """
        self._match_semantics(state)
        self._match_appearance(state)
        self.config.sh_degree = isqrt(state["gauss_params.features_rest"].shape[1] + 1) - 1
        if "camera_optimizer.pose_adjustment" in state and self.config.camera_optimizer.mode == "off":
            self._make_camera_optimizer(wanted=True)
            self.to(self.device)
        self.step = self.config.total_steps
        for name, parameter in self.gauss_params.items():
            saved = state[f"gauss_params.{name}"]
            parameter.data = torch.zeros(saved.shape, dtype=parameter.dtype, device=parameter.device)
        return super(SplatfactoModel, self).load_state_dict(state, **kwargs)

    def _match_appearance(self, state: Mapping[str, Any]) -> None:
        """`auto` means what the checkpoint has; `on` and `off` have to agree with it."""
        saved = "appearance.vectors" in state
        if saved == (self.appearance is not None):
            return
        if self.config.appearance.use != "auto":
            raise UserError(
                f"the checkpoint was trained {'with' if saved else 'without'} appearance: load it with "
                f"--pipeline.model.appearance.use auto, or train anew"
            )
        self.appearance = self._make_appearance().to(self.device) if saved else None

    def _match_semantics(self, state: Mapping[str, Any]) -> None:
        """Build the components that the checkpoint has, or say how they differ."""
        if "clip_mean" not in state:
            return
        saved = {"CLIP": state["clip_mean"], "dense": state["dense_mean"]}
        if self.semantic_field is None:
            self._add_semantics(*saved.values())
        assert self.semantic_field is not None
        if self.semantic_field.needs_lifting and "gauss_params.codes" in state:
            self.gauss_params["codes"] = Parameter(state["gauss_params.codes"].clone(), requires_grad=False)
        self.to(self.device)
        prefix = "semantic_field."
        self.semantic_field.fit_to_state(
            {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
        )
        for kind, mean, prepared in zip(
            saved, saved.values(), (self.clip_mean, self.dense_mean), strict=True
        ):
            if len(mean) != len(prepared):
                raise UserError(
                    f"the checkpoint decodes to {kind} features of width {len(mean)}, but the prepared "
                    f"targets have {len(prepared)}: pass the --pipeline.datamanager.{kind.lower()} that the "
                    f"checkpoint was trained with, or train anew"
                )
