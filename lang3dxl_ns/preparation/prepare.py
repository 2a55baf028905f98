"""Preparation of a scene's targets: CLIP grids, dense features and regions, photo by photo.

Every entry carries the settings that made it. A second run makes only what is missing or was made with other
settings, so an interrupted run is simply repeated.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.console import progress, say, some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.dense_map import RULE, Grid, build_dense_map, map_grids
from lang3dxl_ns.preparation.encoders import (
    CLIP_OPTION,
    DENSE_OPTION,
    DenseEncoder,
    ImageTextEncoder,
    PatchReading,
    find_model,
    load_dense_encoder,
    load_image_text_encoder,
    patch_reading,
)
from lang3dxl_ns.preparation.physical_scale import crop_sides, fine_crops
from lang3dxl_ns.preparation.pyramid import HALF, THIRD, build_clip_target, crop_centers
from lang3dxl_ns.preparation.regions import RegionSource, label_size, stored_labels
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.targets import CLIP, DENSE, FINE, REGIONS, TargetReader
from lang3dxl_ns.preparation.workers import Workers
from lang3dxl_ns.scene.photo import Photo

_CROP_RULE = 4
"""Increased when crops, their encoding or their average change, so that older entries are made again."""
_CHECKERS = 4
"""Threads that check photos."""
_PATCHES_PER_CROP = 32
"""Windows of patch features are encoded this many times fewer at once than crops: they hold more."""
_PATIENCE_S = 1.0
"""Seconds between checks for photos that another process is making."""
_BUSY = "another process is making it"


@dataclass
class PreparedTargets:
    """Result of a preparation."""

    reader: TargetReader
    """Reader for the photos whose targets are complete, in the order given."""
    left_out: dict[str, str]
    """Photos that could not be read, with reasons."""
    encoded: int
    """Number of photos for which this run made something."""


@dataclass
class _Task:
    """A photo's targets to make, and their settings; None for what is up to date."""

    photo: Photo
    sides: list[int]
    scales: list[float]
    clip: dict[str, Any] | None
    dense: dict[str, Any] | None
    regions: dict[str, Any] | None
    has_dense: bool
    has_regions: bool
    is_fine: bool = False
    """Whether the crops are small ones alone, on a finer grid."""
    grids: tuple[Grid, Grid] | None = None
    """Of a map of patch features, which then takes the place of crops."""

    @property
    def clip_kind(self) -> str:
        return FINE if self.is_fine else CLIP

    @property
    def steps(self) -> int:
        """Crops per side."""
        return THIRD if self.is_fine else HALF

    @property
    def is_done(self) -> bool:
        return self.clip is None and self.dense is None and self.regions is None

    def drop_current(self, store: FeatureStore) -> None:
        """Drop the entries that the store has by now."""
        for field, kind in ((CLIP, self.clip_kind), (DENSE, DENSE), (REGIONS, REGIONS)):
            settings = getattr(self, field)
            if settings is not None and store.is_current(kind, self.photo.name, settings):
                setattr(self, field, None)


def prepare(
    photos: Sequence[Photo],
    pixel_sizes: dict[str, float] | None,
    config: PreparationConfig,
    scales: Sequence[float],
    store: FeatureStore,
    device: torch.device | str,
    regions: RegionSource | None = None,
    fine: Collection[str] = (),
) -> PreparedTargets:
    """Makes the missing targets of all photos and says beforehand how many, and how much disk they take.

    pixel_sizes: world units per pixel *of the photo as it is read* (its `width`), by photo name; None for
    relative scales. scales: crop sides in world units, or in photo widths without pixel sizes.
    regions: where label maps come from; None for none. fine: photos that get small crops alone
    (`fine_crops`), the smallest a third of their side apart; if there are some, only they get dense features.

    Photos that can't be read are left out with a warning. Raises UserError when none can be read, a model
    can't be loaded, or the disk is too small.
    """
    left_out: dict[str, str] = {}
    tasks = _plan(photos, pixel_sizes, config, scales, store, regions, left_out, frozenset(fine))
    missing = [task for task in tasks if not task.is_done]
    if missing:
        _make(missing, len(tasks), config, store, device, regions, left_out)
    names = [task.photo.name for task in tasks if task.photo.name not in left_out]
    if not names:
        raise UserError("no photo can be prepared: " + ("; ".join(left_out.values()) or "the scene has none"))
    if left_out:
        say(f"left out {len(left_out)} of {len(photos)} photos:", *(f"  {why}" for why in left_out.values()))
    encoded = sum(task.photo.name not in left_out for task in missing)
    with_dense = [task.photo.name for task in tasks if task.has_dense]
    with_regions = [task.photo.name for task in tasks if task.has_regions]
    reader = TargetReader(store, names, with_dense, with_regions, fine)
    return PreparedTargets(reader, left_out, encoded)


def _plan(
    photos: Sequence[Photo],
    pixel_sizes: dict[str, float] | None,
    config: PreparationConfig,
    scales: Sequence[float],
    store: FeatureStore,
    regions: RegionSource | None,
    left_out: dict[str, str],
    fine: Collection[str],
) -> list[_Task]:
    """A task per photo; unreadable photos go to `left_out`."""
    clip_model = find_model(config.clip, CLIP_OPTION).identity
    patches = patch_reading(config.clip, config.clip_features)
    dense_model = None if not config.makes_dense else find_model(config.dense, DENSE_OPTION).identity

    def plan_one(photo: Photo) -> _Task | UserError:
        try:
            source = _source(photo)
        except UserError as error:
            return error
        pixel_size = 1 / photo.width if pixel_sizes is None else pixel_sizes[photo.name]
        sides, sizes = crop_sides(scales, pixel_size, photo.width)
        if is_fine := photo.name in fine:
            sides, sizes = fine_crops(sides[0], sizes[0])
        grids = (
            None
            if patches is None
            else map_grids(photo.height, photo.width, patches.tokens, config.dense_tokens)
        )
        if patches is not None and grids is not None:
            sides = sorted(math.ceil(photo.width / columns) for _, columns in grids)
            clip = {**source, "encoder": clip_model, "crop_sides": sides, **_dense_settings(patches, grids)}
        else:
            clip = {**source, "encoder": clip_model, "crop_sides": sides, "rule": _CROP_RULE}
        has_dense = dense_model is not None and (is_fine or not fine)
        dense = {**source, "encoder": dense_model, "tokens": config.dense_tokens} if has_dense else None
        labels = None if regions is None else regions.settings(photo)
        settings = None if labels is None else {**source, **labels}
        task = _Task(
            photo, sides, sizes, clip, dense, settings, has_dense, labels is not None, is_fine, grids
        )
        task.drop_current(store)
        return task

    tasks = []
    # Reading and hashing files, in parallel threads.
    with ThreadPoolExecutor(_CHECKERS) as pool, progress("checking photos", len(photos)) as advance:
        for photo, planned in zip(photos, pool.map(plan_one, photos), strict=True):
            advance()
            if isinstance(planned, UserError):
                left_out[photo.name] = str(planned)
            else:
                tasks.append(planned)
    without = [task.photo.name for task in tasks if not task.has_regions]
    if regions is not None and without:
        say(f"{len(without)} of {len(tasks)} photos have no regions: {some(without)}")
    return tasks


def _dense_settings(patches: PatchReading, grids: tuple[Grid, Grid]) -> dict[str, Any]:
    return {"patches": patches.recipe, "grids": grids, "rule": RULE}


def _source(photo: Photo) -> dict[str, Any]:
    """Everything that determines the result of `photo.read()`. The camera matters only if it undistorts."""
    lens = photo.lens
    camera = [lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion, lens.fisheye] if lens.distorts else None
    return {"photo": photo.content_hash(), "size": [photo.width, photo.height], "undistorted": camera}


def _make(
    missing: list[_Task],
    photos: int,
    config: PreparationConfig,
    store: FeatureStore,
    device: torch.device | str,
    regions: RegionSource | None,
    left_out: dict[str, str],
) -> None:
    """Write the missing entries, photo by photo, in the configured number of processes."""
    with_clip, with_dense = any(task.clip for task in missing), any(task.dense for task in missing)
    maker = _Maker(config, store, regions, with_clip, with_dense)
    store.remove_leftovers()
    clip, dense = maker.models(str(device))
    crop_size = clip.crop_size if clip else 0
    _announce(missing, photos, _bytes_needed(missing, clip, dense), crop_size, config, store)
    workers = Workers(config.workers, config.engine, config.address)
    with progress("encoding photos", len(missing)) as advance:
        while missing:
            busy = []
            for task, trouble in workers.run(maker, missing, str(device)):
                if trouble == _BUSY:
                    busy.append(task)
                    continue
                if trouble:
                    left_out[task.photo.name] = trouble
                advance()
            missing, workers = busy, Workers()  # the few that another command is making: wait for them here
            if busy:
                time.sleep(_PATIENCE_S)


@dataclass
class _Maker:
    """Setup of a worker that makes entries."""

    config: PreparationConfig
    store: FeatureStore
    regions: RegionSource | None
    with_clip: bool
    with_dense: bool
    _models: tuple[ImageTextEncoder | None, DenseEncoder | None] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_models": None}  # every process loads its own

    def models(self, device: str) -> tuple[ImageTextEncoder | None, DenseEncoder | None]:
        """The encoders needed; loaded once."""
        if self._models is None:
            c = self.config
            clip = load_image_text_encoder(c.clip, device) if self.with_clip else None
            dense = load_dense_encoder(c.dense, device, c.dense_tokens) if self.with_dense else None
            self._models = clip, dense
        return self._models

    def start(self, device: str) -> Callable[[_Task], str | None]:
        """As `workers.Maker.start`. The work returns why a photo can't be used, or that another process is
        making it, or None."""
        clip, dense = self.models(device)

        def work(task: _Task) -> str | None:
            with self.store.claim(task.photo.name) as is_ours:
                if not is_ours:
                    return _BUSY
                task.drop_current(self.store)  # another process may have made it meanwhile
                if task.is_done:
                    return None
                try:
                    image = task.photo.read()  # once for all kinds
                except UserError as error:
                    return str(error)
                batch = self.config.crop_batch
                _encode(task, image.to(device), clip, dense, self.regions, batch, self.store)
                return None

        return work


def _encode(
    task: _Task,
    image: Float[Tensor, "h w 3"],
    clip: ImageTextEncoder | None,
    dense: DenseEncoder | None,
    regions: RegionSource | None,
    crop_batch: int,
    store: FeatureStore,
) -> None:
    if task.clip and clip and task.grids:
        tokens, windows = clip.crop_size // clip.patch_size, max(crop_batch // _PATCHES_PER_CROP, 1)
        lit = clip.in_known_light(image)
        features = build_dense_map(lit, task.grids, clip.encode_patches, tokens, clip.patch_size, windows)
        tensors = {"features": features, "valid": torch.ones_like(features[..., 0])}
        store.write(task.clip_kind, task.photo.name, tensors, task.clip)
    elif task.clip and clip:
        target = build_clip_target(
            clip.in_known_light(image),
            task.sides,
            task.scales,
            clip.encode_images,
            clip.crop_size,
            crop_batch,
            task.steps,
        )
        tensors = {"features": target.features, "valid": target.valid}
        store.write(task.clip_kind, task.photo.name, tensors, task.clip)
    if task.dense and dense:
        store.write(DENSE, task.photo.name, {"features": dense.encode(image)}, task.dense)
    if task.regions and regions:
        labels = stored_labels(regions.labels(task.photo, image))
        store.write(REGIONS, task.photo.name, {"labels": labels}, task.regions)


def _bytes_needed(tasks: Iterable[_Task], clip: ImageTextEncoder | None, dense: DenseEncoder | None) -> int:
    """Size of the entries to make: two bytes per number."""
    total = 0
    for task in tasks:
        if task.clip and clip:
            rows, columns = (
                task.grids[-1]
                if task.grids
                else [
                    len(crop_centers(n, min(task.sides), task.steps))
                    for n in (task.photo.height, task.photo.width)
                ]
            )
            total += 2 * rows * columns * (clip.dim + 1)
        if task.dense and dense:
            total += 2 * dense.tokens**2 * dense.dim
        if task.regions:
            total += 2 * math.prod(label_size(task.photo.height, task.photo.width))
    return total


def _announce(
    missing: list[_Task],
    photos: int,
    needed: int,
    crop_size: int,
    config: PreparationConfig,
    store: FeatureStore,
) -> None:
    """Log the work ahead, and the disk and memory it needs. Raises UserError if the disk is too small."""
    store.make_folder()
    free = shutil.disk_usage(store.root).free
    if needed > free:
        raise UserError(
            f"the targets of {len(missing)} photos need {_gigabytes(needed)} in {store.root}, and "
            f"{_gigabytes(free)} are free: free some space, or use a larger smallest crop "
            f"(scale range) or fewer dense tokens"
        )
    say(
        f"preparing {len(missing)} photos ({photos - len(missing)} of {photos} are ready): "
        f"{_gigabytes(needed)} in {store.root}, {_gigabytes(free)} are free"
    )
    memory = config.workers * _memory_needed(
        [task.photo for task in missing], config.crop_batch * crop_size**2
    )
    say(
        f"memory beside the encoders: about {_gigabytes(memory)}"
        + (f" in {config.workers} processes" if config.workers > 1 else "")
        + ", whatever the number of photos"
    )


def _memory_needed(photos: Sequence[Photo], crop_pixels: int) -> int:
    """Approximate, per process: the largest photo in float32, thrice (as read, padded, in windows), and a
    batch of crops with the first layers' activations, a dozen times its size."""
    largest = max(photo.width * photo.height for photo in photos)
    return 3 * 4 * (3 * largest + 12 * crop_pixels)


def _gigabytes(size: int) -> str:
    """A size in a suitable unit."""
    unit, name = next(((u, n) for u, n in ((1e9, "GB"), (1e6, "MB")) if size >= u), (1e3, "kB"))
    return f"{size / unit:.2f} {name}"
