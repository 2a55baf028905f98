"""Checkpoints: written whole or not at all, read without executing code, and compared with the run."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from shutil import disk_usage
from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import DAMAGE, UserError, readable
from lang3dxl_ns.common.files import check_regular, locked, replace_durably

CHECKPOINT = "training.ckpt"
"""Name of the checkpoint in a run's folder."""
NOT_A_CHECKPOINT = (*DAMAGE, pickle.UnpicklingError)
"""Exceptions raised when a file that is not a checkpoint is read."""


def alone_in(folder: Path) -> AbstractContextManager[None]:
    """Hold a lock of a run's folder while training there. Raises UserError if another command does."""
    # The folder's own lock is taken whenever its scene changes, also by words that are taught meanwhile.
    return locked(folder / "training.lock", f"another command trains in {folder}: wait for it, or end it")


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


def check_whole(path: Path) -> None:
    """Verify a checkpoint's checksums, which torch doesn't. Raises one of `DAMAGE` for a file that is damaged
    or packed: it might be far larger in memory."""
    check_regular(path)
    with zipfile.ZipFile(path) as archive:
        packed = any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist())
        expect(not packed, "packed, as torch writes none")
        damaged = archive.testzip()
        expect(damaged is None, f"{damaged} has another checksum")


def load_checked(path: Path, tensors: str) -> dict[str, Any]:
    """Read a checkpoint's content on the CPU, without executing code. `tensors` is the name of the part that
    has the model's. Raises one of `NOT_A_CHECKPOINT` for a damaged or another file."""
    check_regular(path)
    state = torch.load(path, map_location="cpu", weights_only=True)
    parts = {tensors: dict, "step": int}
    known = isinstance(state, dict) and all(isinstance(state.get(k), kind) for k, kind in parts.items())
    expect(known, f"it has no {tensors} and step")
    for name, value in state[tensors].items():
        if isinstance(value, Tensor):
            expect(value.layout == torch.strided, f"{name} is a sparse tensor")
            stored = value.untyped_storage().nbytes()
            expect(value.is_cpu and value.nbytes <= stored, f"{name} is larger than what is stored of it")
            sound = not name.endswith(".means") or bool(value.isfinite().any())
            expect(sound, "no Gaussian has a position that is a number")
    return state


def check_same_photos(
    path: Path, before: Mapping[str, str], now: Mapping[str, str], tensors: Mapping[str, Any]
) -> None:
    """Check that a checkpoint's training photos are those of the run that is to go on, and say which ones
    moved between the training and held-out sets.

    Args:
        path: the checkpoint.
        before: split of each photo, by name, of the run that it is of.
        now: the same of the run that is to go on.
        tensors: its tensors.

    Raises:
        UserError: it has corrections of each training photo's camera, and those are other photos.
    """
    corrected = any(name.endswith("pose_adjustment") for name in tensors)
    trained, trains = ([n for n, split in splits.items() if split == "train"] for splits in (before, now))
    if corrected and trained != trains:
        raise UserError(
            f"{path} has corrections of other training photos' cameras: restore those, or train anew"
        )
    if moved := [name for name, split in now.items() if before.get(name, split) != split]:
        say(
            f"{len(moved)} photos moved between the training and held-out sets since this run began "
            f"({some(moved)}): metrics of held-out photos will be too good"
        )


def as_damage(path: Path) -> AbstractContextManager[None]:
    """Turn errors of a damaged checkpoint of `fit` into a UserError."""
    remedy = "restore it, or delete it to train anew (targets are kept)"
    return readable(f"{path} can't be read", remedy, NOT_A_CHECKPOINT)


def read_checkpoint(path: Path, about: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read a run's checkpoint on the CPU; None if there is none. `about` describes the present run. Raises
    UserError if the file is damaged, or its run had another description."""
    if not path.exists():
        return None
    with as_damage(path):
        check_whole(path)
        content = load_checked(path, "tensors")
        then = content["about"]  # of earlier versions, with fewer names
        changed = [name for name in about if name in then and about[name] != then[name]]
    if changed:
        told = [name if name == "photos" else f"{name.replace('_', '-')} {then[name]}" for name in changed]
        raise UserError(
            f"{path.parent} holds another run ({', '.join(told)}): give its options to go on, another --out, "
            "or --restart to train anew"
        )
    return content
