"""Checkpoints of a run of `fit`: written whole or not at all, and read without executing code."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from shutil import disk_usage
from typing import Any

import torch

from lang3dxl_ns.common.errors import DAMAGE, UserError
from lang3dxl_ns.common.files import check_regular, replace_durably

CHECKPOINT = "training.ckpt"
"""Name of the checkpoint in a run's folder."""


def save_checkpoint(path: Path, content: Mapping[str, Any], partial: Path | None = None) -> None:
    """Write a checkpoint beside its place, or at `partial`, and move it in, so that a killed run keeps the
    one before. Raises UserError if it can't be written; earlier ones are kept then, too."""
    partial = partial or path.with_name(f"{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(dict(content), partial)
        replace_durably(partial, path)
    except (OSError, RuntimeError) as error:  # torch raises RuntimeError for a full disk
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        place = next(folder for folder in path.absolute().parents if folder.is_dir())
        raise UserError(
            f"the checkpoint {path} can't be written ({error}; {disk_usage(place).free / 1e9:.1f} GB are "
            "free): free some space; earlier checkpoints are kept, and the run resumes from the latest"
        ) from error


def read_checkpoint(path: Path, about: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read a run's checkpoint on the CPU; None if there is none. `about` describes the present run. Raises
    UserError if the file is damaged, or its run had another description."""
    if not path.exists():
        return None
    try:
        check_regular(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
        before = content["about"]
    except (*DAMAGE, pickle.UnpicklingError) as error:
        raise UserError(
            f"{path} can't be read ({error}): restore it, or delete it to train anew (targets are kept)"
        ) from error
    if changed := [name for name in about if about[name] != before.get(name)]:
        raise UserError(
            f"{path.parent} holds a run with another {' and '.join(changed)}: give its options to go on, "
            "another --out, or --restart to train anew"
        )
    return content
