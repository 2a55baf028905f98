"""Conversion of a run's folder to a `Scene`, without a data manager or photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from lang3dxl_ns.common.device import known_device
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.files.runs import find_config
from lang3dxl_ns.plugin.model import Lang3DXLModelConfig
from lang3dxl_ns.plugin.run_checkpoint import latest_checkpoint
from lang3dxl_ns.plugin.run_settings import read_model_config
from lang3dxl_ns.preparation.targets import SceneFacts
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import NOT_FINISHED
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord
from lang3dxl_ns.training.snapshot import snapshot
from lang3dxl_ns.training.state import Training


def load_run(
    run: str | Path | None = None,
    device: torch.device | str | None = None,
    config: QueryConfig | None = None,
    clip: str | None = None,
) -> Scene:
    """Load the scene of a run (see `find_config`) from its latest checkpoint; other arguments are those of
    `load_scene`. config.yml is read without executing code; nerfstudio's own commands do trust it. Raises
    UserError if the folder has no checkpoint, or the run is damaged or of another method."""
    place, worker = find_config(run), known_device(device)
    settings, checkpoints = read_model_config(place)
    folder, file = place.parent, SceneRecord.read(place.parent / SCENE_FILE)
    path, checkpoint = latest_checkpoint(folder / checkpoints)
    if not isinstance(settings, Lang3DXLModelConfig):
        raise UserError(f"{folder} is a run of another method: train one with ns-train lang3dxl")
    # The checkpoint brings its own Gaussians, so start with as few as possible.
    start = replace(settings, sky_gaussians=0, random_init=False).fitted(settings.total_steps)  # type: ignore[call-arg]
    facts = SceneFacts(file.trained)
    model = Training.begin(start, facts, (torch.eye(4)[:, :3], torch.zeros(4, 3)))
    with readable(f"the checkpoint {path} does not fit the config.yml beside it", "copy both from one run"):
        model.load(model_state(checkpoint["pipeline"]))
    if model.parts.semantics is not None and model.carried is None:
        raise UserError(NOT_FINISHED)
    model.to(worker)
    model.step = start.total_steps
    file = replace(file, clip=clip or file.clip)
    return snapshot(model, file, config=config, cache=folder / "lang3dxl_visible.safetensors")


def model_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """Select the model's part of a pipeline's parameters."""
    return {k.removeprefix("_model."): v for k, v in state.items() if k.startswith("_model.")}
