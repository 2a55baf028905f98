"""Visible Gaussians per view and their sizes, for ranking views without rendering them, and their cache."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.common.console import say, tracked
from lang3dxl_ns.common.files import check_regular, replace_file
from lang3dxl_ns.preparation.store import hash_tensors
from lang3dxl_ns.rendering import Splats, composite
from lang3dxl_ns.rendering.gathering import filled_pixels
from lang3dxl_ns.scene.camera import Camera, resized
from lang3dxl_ns.scene.record import SceneRecord

_LEAST = 1e-3
"""Pixels below which a Gaussian counts as not visible in a view."""
Item = TypeVar("Item")


def spread(items: Sequence[Item], most: int) -> list[Item]:
    """Choose at most this many of the items, evenly spaced."""
    count = min(most, len(items))
    return [items[i * len(items) // count] for i in range(count)]


@dataclass(frozen=True)
class VisibleGaussians:
    """The Gaussians visible in one view."""

    camera: Camera
    rows: Int[Tensor, " m"]
    """Indices of the visible Gaussians."""
    shares: Float[Tensor, " m"]
    """Share of the view that each of these Gaussians fills."""

    @classmethod
    def of(cls, camera: Camera, mass: Float[Tensor, " n"]) -> VisibleGaussians:
        """Build an instance from the pixels that every Gaussian fills."""
        rows = (mass > _LEAST).nonzero().squeeze(1)
        return cls(camera, rows.int(), (mass[rows] / (camera.width * camera.height)).float())

    @property
    def pixels(self) -> Float[Tensor, " m"]:
        """Pixels that each of these Gaussians fills."""
        return self.shares * self.size

    @property
    def size(self) -> int:
        """Number of pixels in the view."""
        return self.camera.width * self.camera.height


def measured(
    record: SceneRecord,
    splats: Splats,
    most: int,
    side: int,
    *,
    cache: Path | None = None,
    watch: Callable[[str], None] | None = None,
) -> Mapping[str, VisibleGaussians]:
    """Measure which Gaussians at most `most` training views show, `side` pixels long, unless the `cache` has
    it. watch: called with a short description of the work."""
    chosen = spread([photo for photo in record.photos if photo.split == "train"], most)
    cameras = {photo.name: resized(photo.camera, side) for photo in chosen}
    key = ""
    if cache is not None:
        masks = [photo.mask_stamp() for photo in chosen]
        key = fingerprint(vars(splats.gaussians), [asdict(record), most, side, splats.antialiased, masks])
        if (kept := load_visible(cache, key, cameras, splats.means.device)) is not None:
            return kept
    views, what = dict[str, VisibleGaussians](), "measuring which Gaussians the photos show, once"
    for name, camera in tracked(cameras.items(), what):
        if watch is not None:
            watch(f"{what}: view {len(views) + 1} of {len(cameras)}")
        size = camera.height, camera.width
        mask = record.photo(name).foreground(size)
        weight = torch.ones(size) if mask is None else mask.float()
        drawn = partial(composite, splats, camera)
        filled = filled_pixels(drawn, weight.to(splats.means.device), len(splats))
        views[name] = VisibleGaussians.of(camera, filled)
    if cache is not None and views:
        save_visible(cache, views, key)
    return views


def fingerprint(state: Mapping[str, Tensor], settings: object) -> str:
    """Hash tensors and settings (as JSON) to 16 hex digits."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode())
    return hash_tensors(digest, state)[:16]


def save_visible(path: Path, views: Mapping[str, VisibleGaussians], key: str) -> None:
    """Write the views, with a key that detects changes. If that fails, log it; they are made again."""
    from safetensors.torch import save

    tensors = {
        "rows": torch.cat([view.rows for view in views.values()]).cpu(),
        "shares": torch.cat([view.shares for view in views.values()]).cpu(),
        "counts": torch.tensor([len(view.rows) for view in views.values()]),
    }
    try:
        replace_file(path, save(tensors, {"key": key, "checksum": fingerprint(tensors, key)}))
    except OSError as error:
        say(f"{path} can't be cached ({error.strerror}): it will be made again the next time")


def load_visible(
    path: Path, key: str, cameras: Mapping[str, Camera], device: torch.device | str
) -> dict[str, VisibleGaussians] | None:
    """Load views cached under this key, which covers names and cameras; None without a sound file of it."""
    from safetensors import SafetensorError, safe_open

    try:
        check_regular(path)
        with safe_open(path, "pt") as file:
            metadata: dict[str, Any] = file.metadata() or {}
            if metadata.get("key") != key:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if metadata["checksum"] != fingerprint(tensors, key):
            return None
        counts = tensors["counts"].tolist()
        rows, shares = (tensors[name].to(device).split(counts) for name in ("rows", "shares"))
    except (OSError, SafetensorError, ValueError, KeyError):
        return None
    named = zip(cameras.items(), rows, shares, strict=True)
    return {name: VisibleGaussians(camera, r, share) for (name, camera), r, share in named}
