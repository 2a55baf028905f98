"""Disk cache of tensors computed once per checkpoint, with a key that detects changes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.files import check_regular, write_atomically


def fingerprint(state: Mapping[str, Any], settings: object) -> str:
    """Hash a state (tensors, or anything `str` can represent) and settings (as JSON) to 16 hex digits."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode())
    for name, value in sorted(state.items()):
        if not isinstance(value, Tensor):
            digest.update(f"{name} {value}".encode())
            continue
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:16]


def save_tensors(path: Path, tensors: Mapping[str, Tensor], key: str, notes: object) -> None:
    """Write tensors with their key, atomically. If that fails, log it; they are computed again next time."""
    from safetensors.torch import save

    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        checksum = fingerprint(stored, notes)
        write_atomically(path, save(stored, {"key": key, "notes": json.dumps(notes), "checksum": checksum}))
    except OSError as error:
        say(f"{path} can't be cached ({error.strerror}): it will be made again the next time")


def load_tensors(path: Path, key: str) -> tuple[dict[str, Tensor], object] | None:
    """Load the tensors and notes of a file with this key; None if there is none, or it is damaged."""
    from safetensors import SafetensorError, safe_open

    try:
        check_regular(path)
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("key") != key:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            notes = json.loads(metadata["notes"])
            return (tensors, notes) if metadata["checksum"] == fingerprint(tensors, notes) else None
    except (OSError, SafetensorError, ValueError, KeyError):
        return None
