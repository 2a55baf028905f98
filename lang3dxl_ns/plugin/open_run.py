"""Loading a run's pipeline from its folder without executing code; nerfstudio's own `eval_setup` trusts
config.yml."""

from __future__ import annotations

from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE

from lang3dxl_ns.common.device import best_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline
from lang3dxl_ns.plugin.trainer_config import Lang3DXLTrainerConfig, read_config
from lang3dxl_ns.query.find_run import find_config
from lang3dxl_ns.query.run_checkpoint import latest_checkpoint


def open_run(run: str | Path | None) -> tuple[Lang3DXLTrainerConfig, Lang3DXLPipeline, int]:
    """Settings, pipeline (in evaluation mode) and iteration of a run's latest checkpoint.

    run: as for `find_config`. Raises UserError for a config.yml that is damaged, asks for more than settings,
    or is of another method; and for a checkpoint that is missing, damaged, or does not fit the settings.
    """
    config_path = find_config(run).absolute()
    config = read_config(config_path)
    if not isinstance(config, Lang3DXLTrainerConfig):
        raise UserError(f"{config_path} is a run of another method: use nerfstudio's own commands")
    folder = config_path.parent
    path, state = latest_checkpoint(folder / config.relative_model_dir)
    # The folder may have moved: nerfstudio composes its path from these.
    config.output_dir, config.experiment_name, config.method_name = folder.parent, "", ""
    config.timestamp, config.load_dir, config.pipeline.datamanager.run = folder.name, path.parent, folder
    pipeline = config.pipeline.setup(device=best_device(), test_mode="test")
    assert isinstance(pipeline, Lang3DXLPipeline)
    pipeline.eval()
    pipeline.load_pipeline(state["pipeline"], state["step"])
    CONSOLE.log(f"Loaded {path}")
    return config, pipeline, state["step"]
