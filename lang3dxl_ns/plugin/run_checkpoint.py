"""Checkpoints of nerfstudio's runs, read without executing code, and checked for damage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.training.checkpoint import NOT_A_CHECKPOINT, check_whole, load_checked


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
    remedy = (
        "nothing in it was run. Pass a run's config.yml, in --load-dir its folder nerfstudio_models, in "
        "--load-checkpoint one of its step-….ckpt files"
    )
    with readable(f"{path} is not a checkpoint of lang3dxl", remedy, NOT_A_CHECKPOINT):
        return load_checked(path, "pipeline")


def check_checkpoint(place: Path) -> None:
    """Verify the checksums of the checkpoint at a path, or of the latest one in a folder. Raises UserError if
    it is damaged. A folder without checkpoints is accepted, since runs start with one."""
    checkpoints = sorted(place.glob("step-*.ckpt")) if place.is_dir() else [place]
    if not checkpoints or not checkpoints[-1].exists():
        return
    remedy = (
        "copy it again if the copy was incomplete, move it away to resume from an earlier one, or train anew "
        "(prepared targets are kept)"
    )
    with readable(f"the checkpoint {checkpoints[-1]} is damaged", remedy):
        check_whole(checkpoints[-1])
