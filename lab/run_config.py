"""Configuration of a training run inside another command."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

from lang3dxl_ns.methods import METHODS
from lang3dxl_ns.plugin.trainer_config import Lang3DXLTrainerConfig


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
