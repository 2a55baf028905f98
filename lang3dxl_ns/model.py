"""Lang3D-XL's model: splatfacto's Gaussians with a semantic code each, and the field that decodes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
import torch.nn.functional as F
from gsplat.strategy import DefaultStrategy
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.models.splatfacto import (
    RGB2SH,
    SplatfactoModel,
    SplatfactoModelConfig,
    num_sh_bases,
)
from nerfstudio.utils.colors import get_color
from nerfstudio.utils.rich_utils import CONSOLE
from pytorch_msssim import SSIM
from torch import Tensor, nn
from torch.nn import Parameter

from lang3dxl_ns.components import losses, schedules
from lang3dxl_ns.components.downsampler import AttenuatedDownsampler, DownsamplerConfig
from lang3dxl_ns.components.semantic_field import SemanticField, SemanticFieldConfig
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.feature_metrics import feature_metrics
from lang3dxl_ns.evaluation.image_metrics import Lpips, psnr
from lang3dxl_ns.geometry import sphere_around, view_matrix
from lang3dxl_ns.preparation.prepare import FeatureStatistics
from lang3dxl_ns.rendering import Camera, Gaussians, Rendering, rasterize, spherical_harmonics
from lang3dxl_ns.rendering.gaussians import MAX_LOG_SCALE
from lang3dxl_ns.timing import part

SHORT_FIELD_RUN = 5_000
"""Runs of fewer iterations take the field's `short` preset."""


@dataclass
class Lang3DXLModelConfig(SplatfactoModelConfig):
    """Splatfacto's settings, with the method's schedule, and the semantic components."""

    _target: type = field(default_factory=lambda: Lang3DXLModel)
    semantic_field: SemanticFieldConfig = field(default_factory=SemanticFieldConfig)
    """Decoder from a 3-number code to CLIP and dense features."""
    downsampler: DownsamplerConfig = field(default_factory=DownsamplerConfig)
    """Brings decoded features to the grid of the CLIP target; training only."""
    clip_weight: float = 1.0
    """Weight of the CLIP loss (mean absolute difference)."""
    dense_weight: float | None = None
    """Weight of the dense (DINO) loss. None: 2 in short runs, 0.5 in long ones."""
    region_weight: float = 5e-4
    """Weight of the variance inside regions; takes part where a scene has regions."""
    decode_size: tuple[int, int] | None = None
    """The code map is decoded at a random size in this range: pixels of its longer side, inclusive.
    None: 56 to 72 in short runs, 80 to 120 (the paper's) in long ones."""
    warm_up: float = 0.0
    """Fraction of the run that trains colours only, before the semantic losses begin."""
    freeze_geometry_after_warm_up: bool = False
    """Stop training everything but the codes and the semantic components when the warm-up ends."""
    feature_gradient_to_geometry: bool = False
    """Let the semantic losses move Gaussians and opacities too, as the authors' code does."""
    divide_codes_by_alpha: bool = False
    """Decode code ÷ coverage instead of the code, so that half-covered pixels keep their code."""
    sky_gaussians: int = 2_000
    """Gaussians on a sphere around the scene, which take up the sky and the far distance, where a COLMAP
    model has no points; 0 for none."""
    total_steps: int = 30_000
    """Iterations of the run, to which the fractions below refer; set by the trainer."""
    densify_from: float = 1 / 15
    """Fraction of the run at which densification begins (the paper: 2,000 of 30,000)."""
    densify_until: float = 0.5
    """Fraction of the run at which it ends."""
    densify_every: float = 1 / 15
    """Fraction of the run between two densifications (the paper: every 2,000)."""
    background_color: Literal["random", "black", "white"] = "black"
    """Black, as in the paper: where nothing is seen the code is zero as well."""
    num_downscales: int = 0
    """Photos have many sizes already: no extra coarse-to-fine resolution."""
    ssim_lambda: float = 0.5
    """Weight of 1 − SSIM against L1 in the colour loss."""
    cull_alpha_thresh: float = 0.005
    """Gaussians below this opacity are pruned."""
    use_absgrad: bool = False
    """Densify by the norm of the mean gradient, as in the paper."""
    densify_grad_thresh: float | None = None  # type: ignore[assignment]
    """Screen-space gradient (image = [−1, 1]) above which Gaussians are split or duplicated. None: 2e-4 (the
    paper's) in long runs; 2e-3 in short ones, which begin to densify while gradients are still large."""

    def fit_to_run(self, iterations: int) -> None:
        """Settle what depends on the length of the run."""
        short = iterations < SHORT_FIELD_RUN
        self.total_steps = iterations
        if self.semantic_field.preset == "auto":
            self.semantic_field.preset = "short" if short else "default"
        if self.densify_grad_thresh is None:
            self.densify_grad_thresh = 2e-3 if short else 2e-4
        if self.dense_weight is None:
            self.dense_weight = 2.0 if short else 0.5
        if self.decode_size is None:
            self.decode_size = (56, 72) if short else (80, 120)


class Lang3DXLModel(SplatfactoModel):
    """Gaussians with colours and semantic codes; without targets to learn (clip = none) it has no
    semantic parts at all."""

    config: Lang3DXLModelConfig
    semantic_field: SemanticField | None
    downsampler: AttenuatedDownsampler | None
    clip_mean: Tensor
    dense_mean: Tensor

    def populate_modules(self) -> None:
        """Build Gaussians, components, metrics and strategy (on the CPU; the pipeline moves them)."""
        self.config.fit_to_run(self.config.total_steps)
        self.gauss_params = nn.ParameterDict(self._initial_gaussians())
        self.camera_optimizer = self.config.camera_optimizer.setup(
            num_cameras=self.num_train_data, device="cpu"
        )
        self.semantic_field = self.downsampler = None
        statistics: FeatureStatistics | None = self.kwargs["metadata"].get("feature_statistics")
        if statistics is not None:
            clip, dense = statistics.clip, statistics.dense
            self._add_semantics(clip.mean, clip.mean[:0] if dense is None else dense.mean)
            assert self.semantic_field is not None
            self.semantic_field.set_output_statistics(
                torch.cat([self.clip_mean, self.dense_mean]),
                clip.std if dense is None else torch.cat([clip.std, dense.std]),
            )
        self.step = 0
        self.step_is_sound = True
        self.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
        self.lpips = Lpips()
        self.crop_box = None
        self.background_color = get_color(
            "black" if self.config.background_color == "random" else self.config.background_color
        )
        self.strategy = self._make_strategy()
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)

    def _initial_gaussians(self) -> dict[str, Parameter]:
        """A Gaussian per seed point, as wide as the mean distance to its three nearest neighbours."""
        if self.seed_points is not None and not self.config.random_init:
            means, colours = self.seed_points[0].float(), self.seed_points[1].float() / 255
        else:
            means = (torch.rand(self.config.num_random, 3) - 0.5) * self.config.random_scale
            colours = torch.rand(self.config.num_random, 3)
        if self.config.sky_gaussians:
            sky = sphere_around(means, self.config.sky_gaussians)
            means = torch.cat([means, sky])
            colours = torch.cat([colours, torch.full_like(sky, 0.5)])
        n = len(means)
        if n < 4:
            raise UserError(
                f"the scene has {n} seed points, too few to start from: reconstruct it again, or pass "
                f"--pipeline.model.random-init True"
            )
        spacing = torch.from_numpy(self.k_nearest_sklearn(means, 3)[0]).mean(dim=-1, keepdim=True)
        # Points that coincide would make Gaussians of no size.
        spacing = spacing.clamp_min(1e-3 * float(spacing.median().clamp_min(1e-6)))
        return {
            "means": Parameter(means),
            "scales": Parameter(spacing.log().repeat(1, 3)),
            # Uniform over rotations; from a generator of its own, so that preparation has no say in it.
            "quats": Parameter(
                F.normalize(torch.randn(n, 4, generator=torch.Generator().manual_seed(0)), dim=1)
            ),
            "features_dc": Parameter(
                RGB2SH(colours) if self.config.sh_degree > 0 else torch.logit(colours, eps=1e-4)
            ),
            "features_rest": Parameter(torch.zeros(n, num_sh_bases(self.config.sh_degree) - 1, 3)),
            "opacities": Parameter(torch.logit(0.1 * torch.ones(n, 1))),
        }

    def _add_semantics(self, clip_mean: Float[Tensor, " c"], dense_mean: Float[Tensor, " d"]) -> None:
        """Give every Gaussian a code, and build the field and the downsampler for features of this width."""
        self.register_buffer("clip_mean", clip_mean)
        self.register_buffer("dense_mean", dense_mean)
        self.semantic_field = SemanticField(self.config.semantic_field, len(clip_mean), len(dense_mean))
        self.downsampler = AttenuatedDownsampler(self.config.downsampler, len(clip_mean))
        self.gauss_params["codes"] = Parameter(self.semantic_field.initial_codes(self.num_points))

    def _make_strategy(self) -> DefaultStrategy:
        c, steps = self.config, self.config.total_steps
        return DefaultStrategy(
            prune_opa=c.cull_alpha_thresh,
            grow_grad2d=c.densify_grad_thresh,
            grow_scale3d=c.densify_size_thresh,
            grow_scale2d=c.split_screen_size,
            prune_scale3d=c.cull_scale_thresh,
            prune_scale2d=c.cull_screen_size,
            refine_scale2d_stop_iter=0,
            refine_start_iter=round(c.densify_from * steps),
            refine_stop_iter=round(c.densify_until * steps),
            refine_every=max(round(c.densify_every * steps), 1),
            # The paper never resets opacities in a run of 70,000.
            reset_every=10**9,
            pause_refine_after_reset=0,
            absgrad=c.use_absgrad,
            verbose=False,
        )

    # ── training ────────────────────────────────────────────────────────────────────────────────────

    def step_cb(self, optimizers, step: int) -> None:
        """Before an iteration: tell the components how far the run is."""
        super().step_cb(optimizers, step)
        if self.semantic_field is not None:
            self.semantic_field.set_progress(step / self.config.total_steps)
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
            groups["field_encoding"] = list(self.semantic_field.encoding_parameters())
            groups["field_decoder"] = list(self.semantic_field.decoder_parameters())
            groups["downsampler"] = list(self.downsampler.parameters())
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
        """Render a camera: `rgb`, `accumulation`, `background`; in training `bottleneck` (codes [H, W, 3]);
        otherwise also `depth` and `semantics`, the codes as a picture in [0, 1]."""
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
                outputs["bottleneck"] = codes
            else:
                # Kept aside for the metrics: viewers show every output, and would show this one raw.
                self.rendered_codes = codes
                outputs["semantics"] = codes.sigmoid() * rendering.alpha
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
        rendering = rasterize(
            Gaussians(
                g["means"],
                g["quats"],
                g["scales"].clamp_max(MAX_LOG_SCALE).exp(),
                g["opacities"].sigmoid().squeeze(-1),
            ),
            view,
            self._colours(g, pose[0, :, 3].to(self.device)),
            background,
            features=g["codes"] if "codes" in g and self._warm_up_is_over else None,
            detach_features=not self.config.feature_gradient_to_geometry,
            render_depth=not self.training or self.config.output_depth_during_training,
            antialiased=self.config.rasterize_mode == "antialiased",
            absgrad=self.strategy.absgrad and self.training,
        )
        return rendering, background

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
        if "bottleneck" in outputs and "clip_target" in batch:
            loss |= self._semantic_losses(outputs["bottleneck"], batch, mask)
        return loss

    def _semantic_losses(
        self, codes: Float[Tensor, "h w 3"], batch: dict, mask: Tensor | None
    ) -> dict[str, Tensor]:
        c = self.config
        assert c.dense_weight is not None
        ramp = schedules.semantic_ramp(self.step / c.total_steps)
        clip, dense, small_mask = self._decode_small(codes, mask, self._random_size())
        with part("downsample"):
            predicted, weight = self._downsample(clip, batch, small_mask)
        with part("losses"):
            # Cells that see little of the foreground say little about it.
            weight = None if small_mask is None else weight
            loss = {"clip": ramp * c.clip_weight * losses.clip_loss(predicted, batch["clip_target"], weight)}
            if dense is not None and "dense_target" in batch:
                difference = losses.dense_loss(dense, batch["dense_target"], small_mask)
                loss["dense"] = ramp * c.dense_weight * difference
            if "regions" in batch:
                labels = _resize(batch["regions"][..., None].float(), clip.shape[:2])[..., 0].long()
                loss["regions"] = c.region_weight * losses.region_variance_loss(clip, labels, small_mask)
        return loss

    def _decode_small(self, codes: Float[Tensor, "H W 3"], mask: Tensor | None, longer_side: int):
        """Decode a map resized (nearest) to a given longer side → clip [h, w, C], dense, mask [h, w]."""
        height, width = codes.shape[:2]
        scale = min(longer_side / max(height, width), 1.0)
        size = max(round(height * scale), 1), max(round(width * scale), 1)
        small_mask = None if mask is None else _resize(mask[..., None].float(), size)[..., 0]
        assert self.semantic_field is not None
        with part("decode"):
            clip, dense = self.semantic_field(_resize(codes, size))
        return clip, dense, small_mask

    def _downsample(self, clip: Float[Tensor, "h w c"], batch: dict, mask: Tensor | None):
        assert self.downsampler is not None
        return self.downsampler(clip, tuple(batch["clip_target"].shape[:2]), batch["crop_sides"], mask)

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
        """Held-out photo: PSNR, SSIM, LPIPS where its weights are at hand, and feature metrics."""
        target = self.get_gt_img(batch["image"])
        predicted = outputs["rgb"]
        chw = [image.permute(2, 0, 1)[None] for image in (target, predicted)]
        metrics = {"psnr": float(psnr(predicted, target)), "ssim": float(self.ssim(*chw))}
        perceptual = self.lpips(*chw)
        if perceptual is not None:
            metrics["lpips"] = perceptual
        images = {"img": torch.cat([target, predicted], dim=1)}
        if "semantics" in outputs:
            images["semantics"] = outputs["semantics"]
            if "clip_target" in batch:
                metrics |= self._feature_metrics(batch)
        return metrics, images

    def _feature_metrics(self, batch: dict) -> dict[str, float]:
        """Agreement with the held-out photo's targets, beside that of the mean feature of training."""
        assert self.semantic_field is not None and self.config.decode_size is not None
        mask = batch["mask"][..., 0] if "mask" in batch else None
        clip, dense, small_mask = self._decode_small(self.rendered_codes, mask, self.config.decode_size[1])
        predicted, weight = self._downsample(clip, batch, small_mask)
        metrics = feature_metrics("clip", predicted, batch["clip_target"], self.clip_mean, weight)
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
        self.step = self.config.total_steps
        for name, parameter in self.gauss_params.items():
            saved = state[f"gauss_params.{name}"]
            parameter.data = torch.zeros(saved.shape, dtype=parameter.dtype, device=parameter.device)
        return super(SplatfactoModel, self).load_state_dict(state, **kwargs)

    def _match_semantics(self, state: Mapping[str, Any]) -> None:
        """Build the components that the checkpoint has, or say how they differ."""
        if "gauss_params.codes" not in state:
            return
        saved = {"CLIP": state["clip_mean"], "dense": state["dense_mean"]}
        if self.semantic_field is None:
            self._add_semantics(*saved.values())
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


def _resize(image: Float[Tensor, "H W c"], size: tuple[int, int]) -> Float[Tensor, "h w c"]:
    """Nearest-exact: picks samples, since averaging codes would make codes of nothing."""
    return F.interpolate(image.permute(2, 0, 1)[None], size, mode="nearest-exact")[0].permute(1, 2, 0)
