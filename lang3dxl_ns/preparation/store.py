"""Prepared targets on disk: a file per photo and kind, written whole or not at all, read without loading."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.files import write_atomically

logger = logging.getLogger(__name__)

_HALF_MAX = torch.finfo(torch.float16).max
_LEFTOVER_AGE_S = (
    3600.0  # a write takes seconds: an older temporary file belongs to a process that was killed
)


class FeatureStore:
    """A folder of safetensors files: `root/kind/photo.safetensors`, each with the settings that made it.

    Floating tensors are kept in float16. Any number of processes may read and write at the same time: the
    last complete write of an entry stands.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def path(self, kind: str, name: str) -> Path:
        """Where the entry lies. Names that differ in any way never share a file, on any file system."""
        digest = hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:16]
        readable = re.sub(r"[^A-Za-z0-9._-]", "_", name)[-80:]
        return self.root / kind / f"{readable}.{digest}.safetensors"

    def write(self, kind: str, name: str, tensors: dict[str, Tensor], settings: dict[str, Any]) -> None:
        """Stores an entry, atomically: after a failure at any moment the old entry, or none, is there.

        Raises UserError on NaN or infinity, and when the disk is full.
        """
        from safetensors.torch import save

        stored = {key: _compact(tensor, f"{key} of {name} ({kind})") for key, tensor in tensors.items()}
        content = save(stored, metadata={"settings": _canonical(settings)})
        self.write_bytes(self.path(kind, name), content, f"{name} ({kind})")

    def write_bytes(self, path: Path, content: bytes, what: str) -> None:
        """Writes a file of the store, atomically. Raises UserError when the disk is full."""
        try:
            write_atomically(path, content)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise UserError(
                f"no space left in {self.root} while writing {what}: free some space and run the "
                "same command again, what was written before is kept"
            ) from error

    def read(self, kind: str, name: str) -> dict[str, Tensor]:
        """An entry's tensors, mapped into memory: only what is touched is read from disk. CPU, float16.

        Raises UserError when the entry is missing or damaged.
        """
        path = self.path(kind, name)
        with _opened(path, f"{kind} of {name}") as file:
            return {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)

    def shapes(self, kind: str, name: str) -> dict[str, tuple[int, ...]]:
        """The shapes of an entry's tensors, from its header alone. Raises as `read`."""
        with _opened(self.path(kind, name), f"{kind} of {name}") as file:
            return {key: tuple(file.get_slice(key).get_shape()) for key in file.keys()}  # noqa: SIM118

    def settings(self, kind: str, name: str) -> dict[str, Any]:
        """The settings that made an entry. Raises as `read`."""
        with _opened(self.path(kind, name), f"{kind} of {name}") as file:
            return json.loads(file.metadata()["settings"])

    def is_current(self, kind: str, name: str, settings: dict[str, Any]) -> bool:
        """Whether the entry is there, whole, and made with these settings. A damaged one counts as absent."""
        if not self.path(kind, name).exists():
            return False
        try:
            return _canonical(self.settings(kind, name)) == _canonical(settings)
        except (UserError, ValueError) as error:
            logger.warning("%s; it will be made again", error)
            return False

    def size(self) -> int:
        """Bytes on disk, of all entries."""
        return sum(path.stat().st_size for path in self.root.glob("*/*.safetensors"))

    def remove_leftovers(self) -> None:
        """Deletes the temporary files of processes that were killed while writing."""
        for path in self.root.glob("*/*.tmp"):
            with contextlib.suppress(FileNotFoundError):  # another process may clean up too
                if time.time() - path.stat().st_mtime > _LEFTOVER_AGE_S:
                    path.unlink()


@contextlib.contextmanager
def _opened(path: Path, what: str) -> Iterator[Any]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            if "settings" not in (file.metadata() or {}):
                raise UserError(f"{path} ({what}) was not written by lang3dxl-ns: delete it")
            yield file
    except FileNotFoundError as error:
        raise UserError(f"{what} is not prepared: {path} does not exist; run `lang3dxl prepare`") from error
    except SafetensorError as error:
        raise UserError(
            f"{path} ({what}) is damaged ({error}): delete it and run `lang3dxl prepare`"
        ) from error


def _compact(tensor: Tensor, what: str) -> Tensor:
    """The tensor as it is stored: contiguous, on the CPU, floats in half precision where they fit."""
    tensor = tensor.detach().cpu().contiguous()
    if not tensor.is_floating_point():
        return tensor
    if not torch.isfinite(tensor).all():
        raise UserError(
            f"{what} holds NaN or infinity: the model's weights are damaged or overflow in float16"
        )
    fits = tensor.numel() == 0 or float(tensor.abs().max()) <= _HALF_MAX
    return tensor.to(torch.float16 if fits else torch.float32)


def _canonical(settings: dict[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True)
