"""Conversion of a run's folder to a `Scene`, without a data manager or photos."""

from __future__ import annotations

import pickle
import struct
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.data.scene_box import SceneBox
from torch import Tensor

from lang3dxl_ns.common.device import best_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import check_regular
from lang3dxl_ns.plugin.handover import SceneFacts
from lang3dxl_ns.plugin.model import Lang3DXLModel, Lang3DXLModelConfig
from lang3dxl_ns.plugin.saved_config import read_model_config
from lang3dxl_ns.query.find_run import find_config
from lang3dxl_ns.query.query_config import QueryConfig
from lang3dxl_ns.query.run_file import SCENE_FILE, SceneFile
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import EncodeTexts

NOT_A_CHECKPOINT = (
    *(OSError, EOFError, RuntimeError, pickle.UnpicklingError),
    *(LookupError, TypeError, ValueError, AttributeError, ArithmeticError, AssertionError),
    *(MemoryError, struct.error),
)
"""Exceptions raised on reading a file that is not a checkpoint."""
NOT_FINISHED = "this run has no semantics yet: they are learned when training ends; resume it (--load-dir)"


def load_run(
    run: str | Path | None = None,
    device: torch.device | str | None = None,
    config: QueryConfig | None = None,
    encode_texts: EncodeTexts | None = None,
) -> Scene:
    """The scene of a run, from its latest checkpoint.

    Args:
        run: the run's folder, a folder above it (the newest run there is taken), or its config.yml; None:
            the newest under outputs/. The file is loaded without executing code (nerfstudio's own
            commands, ns-eval and others, do trust it).
        device: by default a GPU if there is one.
        config: defaults of queries.
        encode_texts: the run's CLIP, if it is already loaded.

    Raises:
        UserError: the folder has no checkpoint, or the run is damaged or of another method.
    """
    path = find_config(run)
    settings_of_model, checkpoints = read_model_config(path)
    file = SceneFile.read(path.parent / SCENE_FILE)
    model = _load_model(
        settings_of_model, path.parent / checkpoints, file, torch.device(device or best_device())
    )
    if model.semantic_field is not None and model.carried is None:
        raise UserError(NOT_FINISHED)
    return model.scene(
        file, config=config, encode_texts=encode_texts, cache=path.parent / "lang3dxl_visible.safetensors"
    )


def _load_model(config: Any, checkpoints: Path, file: SceneFile, device: torch.device) -> Lang3DXLModel:
    path, checkpoint = latest_checkpoint(checkpoints)
    state = checkpoint["pipeline"]
    if not isinstance(config, Lang3DXLModelConfig):
        raise UserError(f"{checkpoints.parent} is a run of another method: train one with ns-train lang3dxl")
    names, metadata = [photo.name for photo in file.photos if photo.split == "train"], dict[str, Any]()
    SceneFacts(names).into(metadata)
    # The checkpoint brings its own Gaussians: start with the fewest possible.
    start = replace(config, sky_gaussians=0, random_init=False)  # type: ignore[call-arg]
    model = start.setup(
        scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])),
        num_train_data=len(names),
        metadata=metadata,
        device=device,
        grad_scaler=None,
        seed_points=(torch.eye(4)[:, :3], torch.zeros(4, 3)),
    )
    assert isinstance(model, Lang3DXLModel)
    try:
        model.load_state_dict(model_state(state), strict=True)
    except (RuntimeError, LookupError, TypeError, AttributeError) as error:
        raise UserError(
            f"the checkpoint {path} does not fit the config.yml beside it ({error}): copy both from one run"
        ) from error
    return model.to(device).eval()


def model_state(state: dict[str, Any]) -> dict[str, Any]:
    """The model's part of a pipeline's parameters."""
    return {k.removeprefix("_model."): v for k, v in state.items() if k.startswith("_model.")}


def latest_checkpoint(folder: Path) -> tuple[Path, dict[str, Any]]:
    """Path and content of the latest checkpoint in a folder, on the CPU, loaded without executing code.

    Raises UserError if there is none, or it is damaged, or not a run's checkpoint.
    """
    checkpoints = sorted(folder.glob("step-*.ckpt"))
    if not checkpoints:
        raise UserError(f"{folder} holds no checkpoint: train for longer, or copy it")
    check_checkpoint(checkpoints[-1])
    return checkpoints[-1], read_checkpoint(checkpoints[-1])


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Content of a checkpoint of any nerfstudio run, on the CPU. Raises UserError for another file."""
    try:
        check_regular(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except NOT_A_CHECKPOINT as error:
        raise _no_checkpoint(path, error) from error
    shape = {"pipeline": dict, "step": int}
    if not isinstance(state, dict) or not all(isinstance(state.get(k), v) for k, v in shape.items()):
        raise _no_checkpoint(path, "it has no pipeline and step")
    for name, value in state["pipeline"].items():
        if isinstance(value, Tensor) and value.layout != torch.strided:
            raise _no_checkpoint(path, f"{name} is a sparse tensor")
        if isinstance(value, Tensor) and value.nbytes > value.untyped_storage().nbytes():
            raise _no_checkpoint(path, f"{name} is larger than what is stored of it")
        if name.endswith(".means") and isinstance(value, Tensor) and not value.isfinite().any():
            raise _no_checkpoint(path, "no Gaussian has a position that is a number")
    return state


def _no_checkpoint(path: Path, why: object) -> UserError:
    return UserError(
        f"{path} is not a checkpoint of lang3dxl ({why}); nothing in it was run. Pass a run's "
        "config.yml, in --load-dir its folder nerfstudio_models, in --load-checkpoint one of its step-….ckpt "
        "files"
    )


def check_checkpoint(place: Path) -> None:
    """Verify the checksums of the checkpoint at a path, or of the latest in a folder.

    Raises UserError if it is damaged. A folder without checkpoints is fine: runs start that way.
    """
    checkpoints = sorted(place.glob("step-*.ckpt")) if place.is_dir() else [place]
    if not checkpoints or not checkpoints[-1].exists():
        return
    try:
        check_regular(checkpoints[-1])
        with zipfile.ZipFile(checkpoints[-1]) as archive:
            packed = any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist())
            damaged = "packed, as torch writes none" if packed else archive.testzip()
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, NotImplementedError, zlib.error):
        damaged = "the whole file"
    if damaged is not None:
        raise UserError(
            f"the checkpoint {checkpoints[-1]} is damaged ({damaged}), perhaps by an incomplete copy: copy "
            "it again, move it away to resume from an earlier one, or train anew (prepared targets are kept)"
        )
