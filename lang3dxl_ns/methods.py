"""Method registration for nerfstudio: `ns-train lang3dxl` and `lang3dxl-paper`."""

from __future__ import annotations

import atexit
import sys
from typing import Literal

import torch
from nerfstudio.configs.base_config import LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.plugins.types import MethodSpecification

from lang3dxl_ns.common.settings_help import asked_for_all
from lang3dxl_ns.common.stopping import end_at_once
from lang3dxl_ns.plugin.optimizers import parameter_groups
from lang3dxl_ns.plugin.pipeline import Lang3DXLPipelineConfig
from lang3dxl_ns.plugin.run_settings import check_command_line
from lang3dxl_ns.plugin.trainer_config import Lang3DXLTrainerConfig
from lang3dxl_ns.plugin.wrong_flags import name_wrong_flags
from lang3dxl_ns.training.learning_rates import Rates, learning_rates, printed_learning_rates
from lang3dxl_ns.training.scene_settings import PRINTED_PHOTO_SCALE
from lang3dxl_ns.training.settings import as_printed

check_command_line(sys.argv[1:])
atexit.register(end_at_once)  # before the handlers of torch, which was imported earlier

DEVICE: Literal["cuda", "cpu"] = "cuda" if torch.cuda.is_available() else "cpu"


def _config(method: str, iterations: int, rates: Rates) -> Lang3DXLTrainerConfig:
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
        optimizers=parameter_groups(rates),
        logging=LoggingConfig(profiler="none"),  # the profiler's table would end every command's output
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15, websocket_host="127.0.0.1"),
        vis="viewer",
    )


lang3dxl = MethodSpecification(
    config=_config("lang3dxl", 30_000, learning_rates()),
    description="Lang3D-XL: language in large 3D scenes, from photo collections; on CUDA and on any CPU.",
)
_paper = _config("lang3dxl-paper", 70_000, printed_learning_rates())
as_printed(_paper.pipeline.model, _paper.pipeline.datamanager)
_paper.pipeline.datamanager.camera_res_scale_factor = PRINTED_PHOTO_SCALE
lang3dxl_paper = MethodSpecification(
    config=_paper,
    description="Lang3D-XL as in its paper: codes trained with the scene, composited, then decoded.",
)
METHODS = {"lang3dxl": lang3dxl, "lang3dxl-paper": lang3dxl_paper}
if sys.argv[1:2] and sys.argv[1] in METHODS:
    sys.argv[2:] = asked_for_all(sys.argv[2:])
    name_wrong_flags(METHODS[sys.argv[1]].config)
