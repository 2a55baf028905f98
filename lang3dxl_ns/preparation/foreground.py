"""Where photos count: masks from a folder, from words, or none.

Every source comes down to one thing: the file that is a photo's mask (`Photo.mask_path`), or None where the
whole photo counts. `Photo.read_mask` does the rest, for training, evaluation and queries alike.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from jaxtyping import Bool
from PIL import Image, PngImagePlugin
from torch import Tensor

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.preparation.companions import companion, named_folder
from lang3dxl_ns.preparation.photo import Photo
from lang3dxl_ns.preparation.prepare import PreparationConfig
from lang3dxl_ns.preparation.progress import progress, some
from lang3dxl_ns.preparation.segmentation import TextSegmenter, find_text_segmenter, load_text_segmenter
from lang3dxl_ns.preparation.store import FeatureStore

FOREGROUND = "foreground"
MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG")

_LONGER_SIDE = 1024
"""Pixels at which words are looked for; the networks see no more anyway."""
_RULE = 1
"""Raised when masks are made in another way: those made before are then made again."""

Log = Callable[[str], None]


def with_foreground(
    photos: Sequence[Photo],
    config: PreparationConfig,
    data: Path,
    cache_dir: Path,
    device: torch.device | str,
    log: Log = print,
) -> list[Photo]:
    """The photos with the masks that `config.foreground` asks for; the log says which have none.

    A folder is relative to `data`. Raises UserError when it isn't there or fits no photo, and when a model
    can't be loaded.
    """
    if config.foreground == "none":
        return [replace(photo, mask_path=None) for photo in photos]
    if config.foreground == "text":
        return _prompted(photos, config, FeatureStore(cache_dir), device, log)
    if config.foreground == "auto":
        masked = list(photos)  # as the dataparser found them
    else:
        masked = _from_folder(photos, named_folder(config.foreground, data, "foreground"))
    without = [photo.name for photo in masked if photo.mask_path is None]
    if 0 < len(without) < len(masked):
        log(f"{len(without)} of {len(masked)} photos have no mask and count whole: {some(without)}")
    for path, names in _shared_masks(masked).items():
        log(
            f"{path} is the mask of {len(names)} photos, {some(names)}: where it belongs to one, name it "
            f"like {path.parent / (PurePosixPath(names[0]).name + path.suffix)}"
        )
    return masked


def _shared_masks(photos: Sequence[Photo]) -> dict[Path, list[str]]:
    """Masks that several photos take, since these differ in their suffix alone, and the photos."""
    names: dict[Path, list[str]] = {}
    for photo in photos:
        if photo.mask_path is not None:
            names.setdefault(photo.mask_path, []).append(photo.name)
    return {path: sharing for path, sharing in names.items() if len(sharing) > 1}


def find_mask(folder: Path, name: str, follow_links: bool = False) -> Path | None:
    """A photo's mask in a folder: named like the photo, as PNG or JPEG."""
    return companion(folder, name, MASK_SUFFIXES, follow_links)


def _from_folder(photos: Sequence[Photo], folder: Path) -> list[Photo]:
    masked = [replace(photo, mask_path=find_mask(folder, photo.name)) for photo in photos]
    if all(photo.mask_path is None for photo in masked):
        raise UserError(
            f"no mask in {folder} is named like a photo (the first is {photos[0].name}): name masks like the "
            "photos, with .png or .jpg"
        )
    return masked


def _prompted(
    photos: Sequence[Photo],
    config: PreparationConfig,
    store: FeatureStore,
    device: torch.device | str,
    log: Log,
) -> list[Photo]:
    """Makes the masks that are missing or were made with other settings, photo by photo, and names those in
    which nothing was found: they count whole."""
    if not config.foreground_prompts:
        raise UserError("foreground text needs words: --pipeline.datamanager.foreground-prompts building")
    files = find_text_segmenter(config.foreground_model, config.sam)
    made_with = {"prompts": sorted(config.foreground_prompts), "model": files.identity, "rule": _RULE}
    masked, missing = [], []
    for photo in photos:
        path = store.path(FOREGROUND, photo.name).with_suffix(".png")
        try:
            settings = {**made_with, "photo": photo.content_hash()}
        except UserError:
            masked.append(photo)  # whoever reads the photo says why it can't be read
            continue
        masked.append(replace(photo, mask_path=path))
        if _settings(path) != settings:
            missing.append((photo, path, settings))
    if missing:
        log(f"looking for {', '.join(config.foreground_prompts)} in {len(missing)} of {len(photos)} photos")
        empty = _make(missing, load_text_segmenter(files, device), config.foreground_prompts, store)
        if empty:
            log(f"found nothing in {len(empty)} photos, which count whole: {some(empty)}")
    return masked


def _make(
    missing: list[tuple[Photo, Path, dict[str, Any]]],
    segmenter: TextSegmenter,
    prompts: Sequence[str],
    store: FeatureStore,
) -> list[str]:
    """Writes the masks; returns the names of the photos in which nothing was found."""
    store.remove_leftovers()
    empty = []
    with progress("finding the foreground", len(missing)) as advance:
        for photo, path, settings in missing:
            try:
                image = photo.read_file(_LONGER_SIDE)
            except UserError:
                pass  # as above
            else:
                mask = segmenter.segment(image, prompts)
                if not mask.any():
                    empty.append(photo.name)
                    mask = torch.ones_like(mask)
                store.write_bytes(path, _png(mask, settings), f"the mask of {photo.name}")
            advance()
    return empty


def _png(mask: Bool[Tensor, "h w"], settings: dict[str, Any]) -> bytes:
    """A black-and-white PNG that carries the settings, so that no mask is ever without them."""
    text, content = PngImagePlugin.PngInfo(), io.BytesIO()
    text.add_text("settings", json.dumps(settings))
    Image.fromarray(mask.numpy()).save(content, "PNG", pnginfo=text)
    return content.getvalue()


def _settings(path: Path) -> dict[str, Any] | None:
    """The settings that made a mask; None where there is no whole mask of ours."""
    try:
        with Image.open(path) as image:
            settings = json.loads(image.info.get("settings", "null"))
            image.verify()  # reads all of it
            return settings
    except (OSError, SyntaxError, ValueError):
        return None
