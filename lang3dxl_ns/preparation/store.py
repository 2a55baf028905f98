"""Feature store: prepared targets on disk, one memory-mapped file per photo and kind, written atomically."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import own, read_json, replace_file
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.scene.photo import Photo

logger = logging.getLogger(__name__)

_HALF_MAX = torch.finfo(torch.float16).max
_ENTRY = re.compile(r".+\.[0-9a-f]{16}\.(safetensors|png|jpg)")
"""Names of targets, masks, and photos at working size."""
_HASHES = "photo_hashes.json"
_LEFTOVER_AGE_S = 3600.0
"""Age in seconds from which a temporary file is a leftover of a killed process; a write takes seconds."""
_READERS = 4
"""Number of threads that check photos."""


class PhotosGoneError(UserError):
    """Photos or targets that the work needs have vanished, or were replaced."""


class FeatureStore:
    """Folder of safetensors files, `root/kind/photo.safetensors`, each with the settings that made it.

    Floating-point tensors are stored as float16 if their values allow. Any number of processes may read and
    write at the same time, and the last complete write of an entry wins.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def path(self, kind: str, name: str) -> Path:
        """Return the entry's file. Different names never share a file, on any file system."""
        digest = hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:16]
        readable = re.sub(r"[^A-Za-z0-9._-]", "_", name)[-80:]
        return self.root / kind / f"{readable}.{digest}.safetensors"

    def write(self, kind: str, name: str, tensors: dict[str, Tensor], settings: dict[str, Any]) -> None:
        """Store an entry atomically: a failure at any moment leaves the old entry, or none. Raises UserError
        on NaN or infinity, and if the disk is full or read-only."""
        from safetensors.torch import save

        stored = {key: _compact(tensor, f"{key} of {name} ({kind})") for key, tensor in tensors.items()}
        checksum = hash_tensors(hashlib.blake2b(digest_size=16), stored)
        metadata = {"settings": _canonical(settings), "checksum": checksum}
        path = self.path(kind, name)
        self.write_bytes(path, save(stored, metadata=metadata), f"{name} ({kind})")

    def write_bytes(self, path: Path, content: bytes, what: str) -> None:
        """Write a file of the store atomically. Raises UserError if the disk is full or read-only."""
        own(path.parent)
        with self._writable(what):
            replace_file(path, content)

    def make_folder(self) -> None:
        """Create the store's folder. Raises UserError if the disk is full or read-only."""
        with self._writable("its folder"):
            self.root.mkdir(parents=True, exist_ok=True)

    @contextlib.contextmanager
    def _writable(self, what: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise UserError(
                    f"no space left in {self.root} while writing {what}: free some space and run the same "
                    "command again; what was already written is kept"
                ) from error
            raise UserError(
                f"{self.root} can't be written to ({error.strerror or error}): keep the targets elsewhere "
                f"with {data_option('cache-dir')} DIR"
            ) from error

    def read(self, kind: str, name: str, settings: dict[str, Any] | None = None) -> dict[str, Tensor]:
        """Map an entry's tensors into memory (CPU, float16): only the parts in use are read from disk. Raises
        UserError if the entry is missing or damaged, PhotosGoneError if it was made with other settings than
        the given ones."""
        path = self.path(kind, name)
        with _opened(path, f"{kind} of {name}") as file:
            if settings is not None and file.metadata()["settings"] != _canonical(settings):
                raise PhotosGoneError(
                    f"{path} was overwritten by another command with different settings: repeat this one, "
                    f"and give the other a {data_option('cache-dir')} of its own"
                )
            return {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)

    def is_current(self, kind: str, name: str, settings: dict[str, Any]) -> bool:
        """Return whether the entry exists, matches its checksum, and was made with these settings. A damaged
        one counts as absent."""
        path = self.path(kind, name)
        if not path.exists():
            return False
        try:
            with _opened(path, f"{kind} of {name}") as file:
                metadata = file.metadata()
                if metadata["settings"] != _canonical(settings):
                    return False
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
                if metadata.get("checksum") != hash_tensors(hashlib.blake2b(digest_size=16), tensors):
                    raise UserError(f"{path} ({kind} of {name}) is damaged: its checksum differs")
            return True
        except (UserError, ValueError) as error:
            logger.warning("%s; it will be made again", error)
            return False

    def photo_hashes(self, photos: Sequence[Photo]) -> dict[str, str | UserError]:
        """Compute a hash of every photo's file by name, or the reason why it can't be read. A file is read
        once, and again if its size, modification time or inode has changed."""
        path, known = self.root / _HASHES, dict[str, Any]()
        with contextlib.suppress(OSError, ValueError, TypeError):  # missing or damaged
            known = dict(read_json(path))

        def look(photo: Photo) -> tuple[str | UserError, list[Any] | None]:
            try:
                stamp, recorded = photo.stamp(), known.get(photo.name)
                if not (isinstance(recorded, list) and len(recorded) == 2 and recorded[0] == stamp):
                    recorded = [stamp, photo.content_hash()]
                return recorded[1], recorded
            except UserError as error:
                return error, None

        hashes, found = {}, {}
        with ThreadPoolExecutor(_READERS) as pool:
            looked = tracked(pool.map(look, photos), "checking photos", len(photos))
            for photo, (result, recorded) in zip(photos, looked, strict=True):
                hashes[photo.name] = result
                if recorded:
                    found[photo.name] = recorded
        if any(known.get(name) != entry for name, entry in found.items()):
            with contextlib.suppress(OSError):  # a store that can't be written to can still be read
                replace_file(path, json.dumps({**known, **found}))
        return hashes

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Count the files and bytes on disk, by kind."""
        sizes = {}
        for folder in self._kinds():
            files = [path for path in folder.iterdir() if _ENTRY.fullmatch(path.name)]
            sizes[folder.name] = (len(files), sum(path.stat().st_size for path in files))
        return sizes

    def _kinds(self) -> list[Path]:
        """List the folders of entries. Links may lead into another scene's targets, and are left out."""
        return sorted(path for path in self.root.glob("*") if path.is_dir() and not path.is_symlink())

    def remove_leftovers(self) -> None:
        """Delete temporary files of processes that were killed while writing."""
        for path in (path for folder in self._kinds() for path in folder.glob("*-????????.tmp")):
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
    except (SafetensorError, ValueError) as error:
        raise UserError(f"{path} ({what}) is damaged ({error}): delete it; run `lang3dxl prepare`") from error


def _compact(tensor: Tensor, what: str) -> Tensor:
    """Convert a tensor for storage: contiguous, on the CPU, floats in half precision if values allow."""
    tensor = tensor.detach().cpu().contiguous()
    if not tensor.is_floating_point():
        return tensor
    if not torch.isfinite(tensor).all():
        raise UserError(f"{what} holds NaN or infinity: the weights are damaged or overflow in float16")
    fits = tensor.numel() == 0 or float(tensor.abs().max()) <= _HALF_MAX
    return tensor.to(torch.float16 if fits else torch.float32)


def hash_tensors(digest: Any, tensors: Mapping[str, Tensor]) -> str:
    """Add tensors' names, types, shapes and contents to a digest of hashlib, and return its hex digits."""
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _canonical(settings: dict[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True)
