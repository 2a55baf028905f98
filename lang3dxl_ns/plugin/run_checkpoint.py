"""Checkpoints of nerfstudio's runs, read without executing code, and checked for damage."""

from __future__ import annotations

import pickle
import zipfile
import zlib
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.common.errors import DAMAGE, UserError, not_of_memory
from lang3dxl_ns.common.files import check_regular

NOT_A_CHECKPOINT = (*DAMAGE, pickle.UnpicklingError)
"""Exceptions raised when a file that is not a checkpoint is read."""


def latest_checkpoint(folder: Path) -> tuple[Path, dict[str, Any]]:
    """Load the latest checkpoint in a folder on the CPU, without executing code; return its path and content.
    Raises UserError if there is none, or it is damaged, or not a run's checkpoint."""
    checkpoints = sorted(folder.glob("step-*.ckpt"))
    if not checkpoints:
        raise UserError(f"{folder} holds no checkpoint: train for longer, or copy it")
    check_checkpoint(checkpoints[-1])
    return checkpoints[-1], read_checkpoint(checkpoints[-1])


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Load the content of any nerfstudio run's checkpoint on the CPU. Raises UserError for another file."""
    try:
        check_regular(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except NOT_A_CHECKPOINT as error:
        not_of_memory(error)
        raise _no_checkpoint(path, error) from error
    shape = {"pipeline": dict, "step": int}
    if not isinstance(state, dict) or not all(isinstance(state.get(k), v) for k, v in shape.items()):
        raise _no_checkpoint(path, "it has no pipeline and step")
    tensors = {name: value for name, value in state["pipeline"].items() if isinstance(value, Tensor)}
    for name, value in tensors.items():
        if value.layout != torch.strided:
            raise _no_checkpoint(path, f"{name} is a sparse tensor")
        if value.nbytes > value.untyped_storage().nbytes():
            raise _no_checkpoint(path, f"{name} is larger than what is stored of it")
        if name.endswith(".means") and not value.isfinite().any():
            raise _no_checkpoint(path, "no Gaussian has a position that is a number")
    return state


def _no_checkpoint(path: Path, why: object) -> UserError:
    return UserError(
        f"{path} is not a checkpoint of lang3dxl ({why}); nothing in it was run. Pass a run's "
        "config.yml, in --load-dir its folder nerfstudio_models, in --load-checkpoint one of its step-….ckpt "
        "files"
    )


def check_checkpoint(place: Path) -> None:
    """Verify the checksums of the checkpoint at a path, or of the latest one in a folder. Raises UserError if
    it is damaged. A folder without checkpoints is accepted, since runs start with one."""
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
