"""Short training runs, with nerfstudio (`make_trainer`) and without (`fitted`)."""

from copy import deepcopy
from pathlib import Path

import torch

from lang3dxl_ns.components.field_settings import SemanticFieldConfig


def fitted(data: Path, clip: Path, dense: Path, out: Path, steps: int = 2):
    """A finished `fit.Run`, without nerfstudio, with a small sky and few steps of learning codes."""
    from lang3dxl_ns.common.stages import Stages
    from lang3dxl_ns.scene.capture import open_capture
    from lang3dxl_ns.training.fit import Settings, begin

    settings = Settings.of("lang3dxl", steps)
    settings.targets.clip, settings.targets.dense = str(clip), str(dense)
    settings.scene.sky_gaussians, settings.scene.semantic_field = 50, SemanticFieldConfig(code_dim=3)
    settings.scene.decoder.compression.steps = 20
    run = begin(open_capture(data), settings, out, data / "lang3dxl_cache", "cpu")
    run.complete(Stages({"train": 1.0, "words": 1.0}))
    return run


def make_trainer(data, clip, dense, output_dir, iterations, semantics=True, method="lang3dxl", **changes):
    """A trainer of a registered method, configured as the command line would."""
    from lab.benchmarks.scored_runs import apply_changes
    from lang3dxl_ns.methods import METHODS

    config = deepcopy(METHODS[method].config)
    config.data = config.pipeline.datamanager.data = data
    config.output_dir, config.vis, config.max_num_iterations = output_dir, "tensorboard", iterations
    config.pipeline.datamanager.clip = str(clip) if semantics else "none"
    config.pipeline.datamanager.dense = str(dense) if semantics else "none"
    config.viewer.quit_on_train_completion = True
    config.pipeline.model.sky_gaussians = 400
    compression = config.pipeline.model.decoder.compression
    compression.steps, compression.batch = 20, 512
    config.pipeline.model.semantic_field = SemanticFieldConfig(code_dim=3)
    apply_changes(config, {path.replace("__", "."): value for path, value in changes.items()})
    torch.manual_seed(config.machine.seed)
    config.set_timestamp()
    config.save_config()
    return config.setup(local_rank=0, world_size=1)


def train_run(*given, **changes):
    """The trainer of a finished run, configured as by `make_trainer`."""
    trainer = make_trainer(*given, **changes)
    trainer.setup()
    trainer.train()
    return trainer


def all_finite(state) -> bool:
    """Whether all numbers of a checkpoint's part are finite."""
    if isinstance(state, torch.Tensor):
        return bool(state.isfinite().all())
    values = state.values() if isinstance(state, dict) else state if isinstance(state, list | tuple) else ()
    return all(map(all_finite, values))
