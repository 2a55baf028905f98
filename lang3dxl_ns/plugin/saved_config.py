"""The whole configuration of a run, for nerfstudio's trainer and pipeline."""

from __future__ import annotations

from pathlib import Path

from nerfstudio.engine.trainer import TrainerConfig

from lang3dxl_ns.query.run_settings import no_config, read_settings


def read_config(path: Path) -> TrainerConfig:
    """The configuration of a run, read as `read_settings` does.

    Raises UserError for a missing or damaged file, one of another version, and one that asks for more.
    """
    (config,) = read_settings(path, [()])
    if not isinstance(config, TrainerConfig):
        raise no_config(path)
    return config
