"""Foreground masks of photos: from a folder, from prompts, or none.

Every source yields the file of a photo's mask (`Photo.mask_path`), or None if the whole photo is foreground.
`Photo.read_mask` reads it for training, evaluation and queries alike.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from lang3dxl_ns.common.console import say, some, tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import data_option, switched_on
from lang3dxl_ns.common.pictures import NoPictureError, mask_values, open_picture
from lang3dxl_ns.preparation.segmentation import find_text_segmenter, load_text_segmenter
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.working_photos import kept_picture, mask_png
from lang3dxl_ns.scene.companions import named_folder
from lang3dxl_ns.scene.masks import MaskFolder
from lang3dxl_ns.scene.photo import Photo

_LONGER_SIDE = 1024
"""Longer side in pixels of photos in which prompts are searched; the networks take no more anyway."""
_READERS = 4
"""Number of threads that read masks."""
_RULE = 1
"""Version of the masks, which is increased when they are made in another way, to make older ones again."""


def with_foreground(
    photos: Sequence[Photo],
    config: PreparationConfig,
    data: Path,
    cache_dir: Path,
    device: torch.device | str,
    follow_links: bool = False,
) -> list[Photo]:
    """Return the photos with the masks configured in `config.foreground` (a folder is relative to `data`, and
    with `follow_links` its masks may be links out of it), and say which have none. Raises UserError if a
    folder is missing or matches no photo, if masks are damaged or all dark, and if a model can't be loaded.
    """
    if config.foreground == "none":
        return [replace(photo, mask_path=None) for photo in photos]
    if config.foreground == "text":
        return _prompted(photos, config, FeatureStore(cache_dir), device)
    if config.foreground == "auto":
        masked = list(photos)  # with the masks found by the dataparser
    else:
        folder = named_folder(config.foreground, data, "foreground")
        masks = MaskFolder(folder, follow_links)
        masked = [replace(photo, mask_path=masks.find(photo.name)) for photo in photos]
        if all(photo.mask_path is None for photo in masked):
            raise UserError(
                f"no mask in {folder} is named like a photo (the first is {photos[0].name}): name masks like "
                "the photos, with .png or .jpg"
            )
    masked = _checked(masked, config.skip_damaged_masks)
    without = [photo.name for photo in masked if photo.mask_path is None]
    if 0 < len(without) < len(masked):
        say(f"{len(without)} of {len(masked)} photos have no mask and are used whole: {some(without)}")
    sharing: dict[Path, list[str]] = {}
    for photo in masked:
        if photo.mask_path is not None:
            sharing.setdefault(photo.mask_path, []).append(photo.name)
    for path, names in sharing.items():
        if len(names) > 1:  # photos whose names differ only in their suffix
            say(
                f"{path} is the mask of {len(names)} photos, {some(names)}: if it belongs to one, name it "
                f"like {path.parent / (PurePosixPath(names[0]).name + path.suffix)}"
            )
    return masked


def _checked(photos: list[Photo], skip: bool) -> list[Photo]:
    """Read all masks, name the dark ones, and return the photos. Unreadable masks raise one UserError that
    names them all; with `skip`, a message does, and their photos count whole. Raises UserError if all masks
    are dark."""
    masked = [photo for photo in photos if photo.mask_path is not None]
    with ThreadPoolExecutor(_READERS) as pool:
        states = list(tracked(pool.map(_state, masked), "checking masks", len(masked)))
    damaged = {p.name: state for p, state in zip(masked, states, strict=True) if isinstance(state, str)}
    brightest = dict(zip((photo.name for photo in masked), states, strict=True))
    dark = {name: value for name, value in brightest.items() if isinstance(value, int) and value < 128}
    if damaged and not skip:
        raise UserError(
            f"{len(damaged)} masks can't be read: {'; '.join(damaged.values())}. Replace or remove them, or "
            f"let these photos count whole: {switched_on(data_option('skip-damaged-masks'))}"
        )
    if damaged:
        say(f"{len(damaged)} masks can't be read, and their photos count whole: {some(list(damaged))}")
    if dark and len(dark) == len(photos):
        most = max(dark.values())
        how = f"dark (the brightest pixel has {most} of 255)" if most else "black"
        raise UserError(
            f"all {len(dark)} masks are {how}: nothing would be kept, since white (255) marks what to keep. "
            f"Draw it white, or pass {data_option('foreground')} none"
        )
    if dark:
        say(f"the masks of {len(dark)} photos are black or dark, nothing in them counts: {some(list(dark))}")
    return [replace(photo, mask_path=None) if photo.name in damaged else photo for photo in photos]


def _state(photo: Photo) -> int | str:
    """Return the largest value of a photo's mask, or the reason why it can't be read."""
    assert photo.mask_path is not None
    try:
        with open_picture(photo.mask_path) as image:
            return int(np.asarray(mask_values(image)).max())
    except (OSError, NoPictureError) as error:
        return f"{photo.mask_path} ({error})"


def foreground_kind(config: PreparationConfig) -> str:
    """Name the store's folder of masks made from these prompts: runs with others keep their own."""
    words = [*sorted(config.foreground_prompts), config.foreground_model, config.sam]
    return f"foreground-{hashlib.sha256(json.dumps(words).encode()).hexdigest()[:8]}"


def _prompted(
    photos: Sequence[Photo], config: PreparationConfig, store: FeatureStore, device: torch.device | str
) -> list[Photo]:
    """Make missing or outdated masks and return the photos with them. Photos in which nothing is found are
    named and used whole."""
    if not config.foreground_prompts:
        raise UserError(f"foreground text needs prompts: {data_option('foreground-prompts')} building")
    files = find_text_segmenter(config.foreground_model, config.sam)
    made_with = {"prompts": sorted(config.foreground_prompts), "model": files.identity, "rule": _RULE}
    paths, missing = dict[str, Path](), []
    for photo, known in zip(photos, store.photo_hashes(photos).values(), strict=True):
        if isinstance(known, UserError):
            continue  # reading it later reports the reason
        paths[photo.name] = path = store.path(foreground_kind(config), photo.name).with_suffix(".png")
        settings = json.dumps({**made_with, "photo": known})
        if kept_picture(path, settings) is None:
            missing.append((photo, path, settings))
    if missing:
        say(f"looking for {', '.join(config.foreground_prompts)} in {len(missing)} of {len(photos)} photos")
        segmenter, empty = load_text_segmenter(files, device), []
        store.remove_leftovers()
        for photo, path, settings in tracked(missing, "finding the foreground"):
            try:
                image = photo.read_file(_LONGER_SIDE)
            except UserError:
                del paths[photo.name]  # reading it later reports the reason
                continue
            mask = segmenter.segment(image, config.foreground_prompts)
            if not mask.any():
                empty.append(photo.name)
                mask = torch.ones_like(mask)
            store.write_bytes(path, mask_png(mask, settings), f"the mask of {photo.name}")
        if empty:
            say(f"found nothing in {len(empty)} photos, which are used whole: {some(empty)}")
    return [replace(photo, mask_path=paths.get(photo.name)) for photo in photos]
