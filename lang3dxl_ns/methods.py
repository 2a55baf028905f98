"""Method registration for nerfstudio: `ns-train lang3dxl` and `lang3dxl-paper`."""

from __future__ import annotations

import sys
from copy import deepcopy
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.configs.base_config import LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.plugins.types import MethodSpecification

from lang3dxl_ns.common.settings_help import asked_for_all
from lang3dxl_ns.plugin.optimizers import RunAdamConfig, RunScheduleConfig, parameter_groups
from lang3dxl_ns.plugin.pipeline import Lang3DXLPipelineConfig
from lang3dxl_ns.plugin.run_settings import check_command_line
from lang3dxl_ns.plugin.trainer_config import Lang3DXLTrainerConfig

check_command_line(sys.argv[1:])

DEVICE: Literal["cuda", "cpu"] = "cuda" if torch.cuda.is_available() else "cpu"

EXTENT = 1.1
"""The published extent, 1.1 times the largest distance of a camera from the cameras' center. nerfstudio
scales that distance to about 1."""


def _config(method: str, iterations: int) -> Lang3DXLTrainerConfig:
    """Build the configuration of a method. `iterations` applies on a GPU."""
    return Lang3DXLTrainerConfig(
        method_name=method,
        machine=MachineConfig(device_type=DEVICE),
        # A step on a CPU takes 0.1 s or more, so the default is a run that ends within minutes.
        max_num_iterations=iterations if DEVICE == "cuda" else 3_000,
        steps_per_save=2_000,
        steps_per_eval_batch=0,
        steps_per_eval_image=500,
        steps_per_eval_all_images=0,
        pipeline=Lang3DXLPipelineConfig(),
        optimizers=parameter_groups(),
        logging=LoggingConfig(profiler="none"),  # the profiler's table would end every command's output
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15, websocket_host="127.0.0.1"),
        vis="viewer",
    )


def _paper_config() -> Lang3DXLTrainerConfig:
    """Build the configuration of Lang3D-XL as printed or, where the paper is silent, as released;
    docs/deviations.md lists where. The schedule of 70,000 iterations is scaled to the length of the run. Runs
    of under 30,000 iterations use the learning rates for short runs."""
    config = _config("lang3dxl-paper", 70_000)
    x = 1 / 70_000
    model, data, groups = config.pipeline.model, config.pipeline.datamanager, config.optimizers
    model.decoder.name = "paper"
    model.dense_weight = 0.5
    model.feature_gradient_to_geometry, model.semantic_ramp = True, 15_000 * x
    model.densify_from, model.densify_until, model.densify_every = 2_000 * x, 15_000 * x, 2_000 * x
    model.densify_size_thresh = 0.2 * EXTENT
    model.view_dependence, model.camera_optimization = "on", "off"
    model.appearance.use, model.appearance.preset, model.appearance.opacity_shift = "on", "auto", True
    model.codes_from = "auto"
    data.scale_mode, data.pixel_distance, data.camera_res_scale_factor = "physical", "mean-inner", 0.5
    data.regions, data.sam = "sam", "facebook/sam-vit-huge"
    groups["means"] = {
        "optimizer": RunAdamConfig(lr=1.6e-5 * EXTENT, short_lr=6.4e-4),
        "scheduler": RunScheduleConfig(shape="log-linear", end=0.01, until=30_000 * x),
    }
    groups["codes"]["scheduler"].end = 0.01
    groups["appearance"]["scheduler"].warm = 0.3
    for name in ("field_encoding", "field_decoder", "downsampler"):
        groups[name]["scheduler"].warm = 0.5
    return config


lang3dxl = MethodSpecification(
    config=_config("lang3dxl", 30_000),
    description="Lang3D-XL: language in large 3D scenes, from photo collections; on CUDA and on any CPU.",
)
lang3dxl_paper = MethodSpecification(
    config=_paper_config(),
    description="Lang3D-XL as in its paper: codes trained with the scene, composited, then decoded.",
)
METHODS = {"lang3dxl": lang3dxl, "lang3dxl-paper": lang3dxl_paper}
if sys.argv[1:2] and sys.argv[1] in METHODS:
    sys.argv[2:] = asked_for_all(sys.argv[2:])


def run_config(
    data: Path,
    output_dir: Path,
    experiment_name: str,
    iterations: int,
    clip: str,
    dense: str,
    method: str = "lang3dxl",
) -> Lang3DXLTrainerConfig:
    """Build the configuration for training inside another command, without viewer or interim evaluation."""
    config = deepcopy(METHODS[method].config)
    assert isinstance(config, Lang3DXLTrainerConfig)
    config.data = config.pipeline.datamanager.data = data
    config.output_dir, config.experiment_name = output_dir, experiment_name
    config.vis, config.steps_per_eval_image = "tensorboard", 0
    config.max_num_iterations = iterations
    config.pipeline.datamanager.clip, config.pipeline.datamanager.dense = clip, dense
    return config
