"""Settings of the model: splatfacto's, with the method's schedule, and the semantic components."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from gsplat.strategy import DefaultStrategy
from nerfstudio.models.splatfacto import SplatfactoModelConfig

from lang3dxl_ns.baselines.encoders import EncoderConfig
from lang3dxl_ns.components.appearance import AppearanceConfig
from lang3dxl_ns.components.downsampler import DownsamplerConfig
from lang3dxl_ns.components.semantic_field import SemanticFieldConfig
from lang3dxl_ns.older_config import ReadsOlder

SHORT_FIELD_RUN = 5_000
"""Runs of fewer iterations take the field's `short` preset."""


@dataclass
class Lang3DXLModelConfig(ReadsOlder, SplatfactoModelConfig):
    """Splatfacto's settings, with the method's schedule, and the semantic components."""

    _target: type = field(default_factory=lambda: _model_class())
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """What carries the semantics: the semantic field, or a system that it is compared with."""
    semantic_field: SemanticFieldConfig = field(default_factory=SemanticFieldConfig)
    """Decoder from a 3-number code to CLIP and dense features."""
    downsampler: DownsamplerConfig = field(default_factory=DownsamplerConfig)
    """Brings decoded features to the grid of the CLIP target; training only."""
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    """Colours that change with the light of a photo."""
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
    view_dependence: Literal["auto", "on", "off"] = "auto"
    """Colours that change with the viewing direction (spherical harmonics of `sh_degree`); off leaves one
    colour per Gaussian and a quarter of its numbers. `auto`: as the scene's measured needs say."""
    hash_levels: Literal["auto", "on"] = "on"
    """`on`: keep all levels of the field's grid. `auto`: halfway through the run, drop those that are finer
    than the step of the code from one decoded pixel to the next, which could only learn noise."""
    camera_optimisation: Literal["auto", "on", "off"] = "auto"
    """Refine the cameras while training. `auto`: where the COLMAP model's reprojection error is large."""
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
        if self.appearance.preset == "auto":
            self.appearance.preset = "short" if short else "paper"
        if self.densify_grad_thresh is None:
            self.densify_grad_thresh = 2e-3 if short else 2e-4
        if self.dense_weight is None:
            self.dense_weight = 2.0 if short else 0.5
        if self.decode_size is None:
            self.decode_size = (56, 72) if short else (80, 120)


def make_strategy(config: Lang3DXLModelConfig) -> DefaultStrategy:
    """gsplat's densification with the schedule of the run."""
    steps = config.total_steps
    return DefaultStrategy(
        prune_opa=config.cull_alpha_thresh,
        grow_grad2d=config.densify_grad_thresh,
        grow_scale3d=config.densify_size_thresh,
        grow_scale2d=config.split_screen_size,
        prune_scale3d=config.cull_scale_thresh,
        prune_scale2d=config.cull_screen_size,
        refine_scale2d_stop_iter=0,
        refine_start_iter=round(config.densify_from * steps),
        refine_stop_iter=round(config.densify_until * steps),
        refine_every=max(round(config.densify_every * steps), 1),
        # The paper never resets opacities in a run of 70,000.
        reset_every=10**9,
        pause_refine_after_reset=0,
        absgrad=config.use_absgrad,
        verbose=False,
    )


def _model_class() -> type:
    from lang3dxl_ns.model import Lang3DXLModel  # which needs this file

    return Lang3DXLModel
