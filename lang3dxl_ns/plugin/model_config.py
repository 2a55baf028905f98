"""nerfstudio's configuration of the model: training's settings, under splatfacto's names."""

from __future__ import annotations

from dataclasses import dataclass

from lang3dxl_ns.common.settings_help import showing, without
from lang3dxl_ns.plugin.inert_settings import OF_SPLATFACTO
from lang3dxl_ns.plugin.splatfacto import SplatfactoModelConfig
from lang3dxl_ns.training.settings import TrainingSettings


@without(*OF_SPLATFACTO)
@showing(
    *("decoder", "semantic_field", "appearance", "view_dependence", "camera_optimization", "sky_gaussians"),
    *("rasterizer", "max_gaussians", "sh_degree", "densify_from", "densify_until", "densify_every"),
    *("densify_grad_thresh", "ssim_lambda", "background_color", "clip_weight", "dense_weight"),
)
@dataclass
class ModelSettings(TrainingSettings, SplatfactoModelConfig):  # type: ignore[misc]
    """Settings of training, and of splatfacto where this package has none of its own."""

    num_downscales: int = 0
    """Always 0, since photos already vary in size."""
