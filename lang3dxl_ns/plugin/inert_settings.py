"""Settings without effect, nerfstudio's and, in some runs, this package's: setting one is an error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.optimizers import parameter_groups
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.training.learning_rates import learning_rates
from lang3dxl_ns.training.settings import TrainingSettings, without_effect

OF_SPLATFACTO = (
    *("enable_collider", "collider_params", "loss_coefficients", "eval_num_rays_per_chunk", "prompt"),
    *("warmup_length", "refine_every", "reset_alpha_every", "stop_split_at", "n_split_samples"),
    *("cull_scale_thresh", "cull_screen_size", "split_screen_size", "stop_screen_size_at"),
    *("use_scale_regularization", "max_gauss_ratio", "use_bilateral_grid", "grid_shape"),
    *("color_corrected_metrics", "resolution_schedule", "num_downscales", "output_depth_during_training"),
    *("use_absgrad", "camera_optimizer"),
)
"""Settings of splatfacto's own schedule and parts, which this model does not have."""
OF_IMAGE_CACHES = (
    *("masks_on_gpu", "images_on_gpu", "cache_images", "cache_images_type", "max_thread_workers"),
    *("eval_num_images_to_sample_from", "eval_num_times_to_repeat_images", "eval_image_indices"),
    *("train_cameras_sampling_strategy", "fps_reset_every"),
)
"""Settings of nerfstudio's photo caches and its order of photos, which one bounded cache and rounds of all
photos replace here."""
OF_COLMAP = (
    *("downscale_rounding_mode", "depths_path", "depth_unit_scale_factor", "max_2D_matches_per_3D_point"),
    *("load_3D_points", "train_split_fraction"),
)
"""Settings of nerfstudio's COLMAP reader; this package's reads points always, and depths never."""
_GROUPS_OF_RENDERINGS = ("codes", "field_encoding", "field_decoder", "downsampler")
"""Optimizer groups of such semantics."""


def check_inert(model: TrainingSettings, data: PreparationConfig, optimizers: Mapping[str, Any]) -> None:
    """Raise UserError if a setting that has no effect in this run differs from its default. model, data:
    settings of the model and of the data manager. optimizers: those of the parameter groups."""
    if model.decoder.learns_from_renderings:
        return
    of_scene, of_targets = without_effect(model, data)
    changed = [f"pipeline.model.{name}" for name in of_scene]
    usual = parameter_groups(learning_rates())
    changed += [f"optimizers.{name}" for name in _GROUPS_OF_RENDERINGS if optimizers[name] != usual[name]]
    changed += [f"pipeline.datamanager.{name}" for name in of_targets]
    if changed:
        raise UserError(
            f"--{changed[0].replace('_', '-')} has no effect where semantics are learned after training, as "
            f"with --pipeline.model.decoder.name {model.decoder.name}: leave it off, or train with "
            "ns-train lang3dxl-paper"
        )
