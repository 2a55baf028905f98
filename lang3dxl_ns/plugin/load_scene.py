"""Conversion of a run's folder to a `Scene`, without a data manager or photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.data.scene_box import SceneBox

from lang3dxl_ns.common.device import known_device
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.evaluation.score_run import NOT_FINISHED
from lang3dxl_ns.files.runs import find_config
from lang3dxl_ns.plugin.model import Lang3DXLModel, Lang3DXLModelConfig
from lang3dxl_ns.plugin.run_checkpoint import latest_checkpoint
from lang3dxl_ns.plugin.run_settings import read_model_config
from lang3dxl_ns.preparation.targets import SceneFacts
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord


def load_run(
    run: str | Path | None = None,
    device: torch.device | str | None = None,
    config: QueryConfig | None = None,
    clip: str | None = None,
) -> Scene:
    """Load the scene of a run from its latest checkpoint.

    Args:
        run: the run's folder, a folder above it (the newest run there is taken), or its config.yml; None: the
            newest run under outputs/. The file is loaded without executing code (nerfstudio's own commands,
            such as ns-eval, do trust it).
        device: default: a GPU if there is one.
        config: defaults of queries.
        clip: name or folder of the run's CLIP, if it is not where the run says.

    Raises:
        UserError: the folder has no checkpoint, or the run is damaged or of another method.
    """
    place, worker = find_config(run), known_device(device)
    settings, checkpoints = read_model_config(place)
    folder, file = place.parent, SceneRecord.read(place.parent / SCENE_FILE)
    path, checkpoint = latest_checkpoint(folder / checkpoints)
    if not isinstance(settings, Lang3DXLModelConfig):
        raise UserError(f"{folder} is a run of another method: train one with ns-train lang3dxl")
    names, metadata = [photo.name for photo in file.photos if photo.split == "train"], dict[str, Any]()
    SceneFacts(names).into(metadata)
    # The checkpoint brings its own Gaussians, so start with as few as possible.
    start = replace(settings, sky_gaussians=0, random_init=False)  # type: ignore[call-arg]
    model = start.setup(
        scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])),
        num_train_data=len(names),
        metadata=metadata,
        device=worker,
        grad_scaler=None,
        seed_points=(torch.eye(4)[:, :3], torch.zeros(4, 3)),
    )
    assert isinstance(model, Lang3DXLModel)
    with readable(f"the checkpoint {path} does not fit the config.yml beside it", "copy both from one run"):
        model.load_state_dict(model_state(checkpoint["pipeline"]), strict=True)
    if model.semantic_field is not None and model.run.carried is None:
        raise UserError(NOT_FINISHED)
    model.to(worker).eval()
    file = replace(file, clip=clip or file.clip)
    return model.scene(file, config=config, cache=folder / "lang3dxl_visible.safetensors")


def model_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """Select the model's part of a pipeline's parameters."""
    return {k.removeprefix("_model."): v for k, v in state.items() if k.startswith("_model.")}
