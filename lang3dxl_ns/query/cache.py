"""What a scene computes once per checkpoint and keeps: its views from small, and the lookup table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.files import write_atomically
from lang3dxl_ns.query.lookup import CodeTable, Lookup, TableCheck, TableError
from lang3dxl_ns.rendering import Camera


def fingerprint(state: Mapping[str, Any], settings: object) -> str:
    """16 hex digits over a state (tensors, or anything that `str` can spell) and settings (as JSON)."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode())
    for name, value in sorted(state.items()):
        if not isinstance(value, Tensor):
            digest.update(f"{name} {value}".encode())
            continue
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:16]


def save_tensors(path: Path, tensors: Mapping[str, Tensor], key: str, notes: object) -> None:
    """Write tensors with the key that they answer to; whole or not at all."""
    from safetensors.torch import save

    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_atomically(path, save(stored, {"key": key, "notes": json.dumps(notes)}))


def load_tensors(path: Path, key: str) -> tuple[dict[str, Tensor], object] | None:
    """Tensors and notes of a file with this key; None where there is none, or it is damaged."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("key") != key:
                return None
            return {name: file.get_tensor(name) for name in file.keys()}, json.loads(metadata["notes"])  # noqa: SIM118
    except (OSError, SafetensorError, ValueError, KeyError):
        return None


# ── the lookup ──────────────────────────────────────────────────────────────────────────────────────────


def save_lookup(path: Path, lookup: Lookup, key: str) -> None:
    """Keep a lookup; one without a table too, so that it isn't tried again."""
    table = lookup.table
    tensors = {}
    notes: dict = {"checks": lookup.description()}
    if table is not None:
        tensors = {name: getattr(table, name) for name in _TABLE_TENSORS}
        notes |= {"size": table.size, "bounded": table.bounded}
    save_tensors(path, tensors, key, notes)


def load_lookup(path: Path, key: str, device: torch.device | str) -> Lookup | None:
    """The lookup kept for this key, if there is one."""
    found = load_tensors(path, key)
    if found is None:
        return None
    tensors, notes = found
    assert isinstance(notes, dict)
    checks = [TableCheck(**check | {"error": TableError(**check["error"])}) for check in notes["checks"]]
    if not tensors:
        return Lookup(None, checks)
    parts = {name: tensor.to(device) for name, tensor in tensors.items()}
    return Lookup(CodeTable(notes["size"], notes["bounded"], **parts), checks)


_TABLE_TENSORS = ("low", "extent", "cell_of", "corners", "features")


# ── small views ─────────────────────────────────────────────────────────────────────────────────────────


@dataclass
class SmallView:
    """A training photo's view, rendered small: enough to mark the codes that occur and to rank viewpoints."""

    name: str
    camera: Camera
    codes: Float[Tensor, "h w d"]
    """Half precision."""
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    counts: Bool[Tensor, "h w"]
    """The photo's foreground; codes elsewhere occur too, but nothing is found there."""

    def seen(self, min_alpha: float) -> Bool[Tensor, "h w"]:
        """Pixels that show something."""
        return self.alpha >= min_alpha


def save_small_views(path: Path, views: list[SmallView], key: str) -> None:
    """Keep the maps of small views, one after another in a tensor each."""
    maps = {
        "codes": torch.cat([view.codes.flatten(0, 1) for view in views]),
        "alpha": torch.cat([view.alpha.flatten() for view in views]),
        "depth": torch.cat([view.depth.flatten() for view in views]),
        "counts": torch.cat([view.counts.flatten() for view in views]),
    }
    save_tensors(path, maps, key, None)


def load_small_views(
    path: Path, key: str, cameras: Mapping[str, Camera], device: torch.device | str
) -> list[SmallView] | None:
    """The small views kept for this key, which covers names and cameras."""
    found = load_tensors(path, key)
    if found is None:
        return None
    sizes = [camera.width * camera.height for camera in cameras.values()]
    parts = [found[0][name].to(device).split(sizes) for name in ("codes", "alpha", "depth", "counts")]
    return [
        SmallView(
            name, c, codes.unflatten(0, (c.height, c.width)), *(m.view(c.height, c.width) for m in maps)
        )
        for (name, c), codes, *maps in zip(cameras.items(), *parts, strict=True)
    ]
