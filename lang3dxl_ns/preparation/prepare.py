"""Preparation of a scene's targets: CLIP grids, dense features and regions, photo by photo.

Every entry carries the settings that made it. A second run makes only what is missing or was made with other
settings, so an interrupted run is simply repeated.
"""

from __future__ import annotations

import math
import shutil
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lang3dxl_ns.common.console import progress, say, some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.crop_budget import Crops, choose_crops, input_side
from lang3dxl_ns.preparation.dense_map import RULE, Grid, build_dense_map, map_grids
from lang3dxl_ns.preparation.encoders import (
    CLIP_OPTION,
    DENSE_OPTION,
    DenseEncoder,
    ImageTextEncoder,
    find_model,
    load_dense_encoder,
    load_image_text_encoder,
    patch_reading,
    spoken,
)
from lang3dxl_ns.preparation.model_files import BUILTIN
from lang3dxl_ns.preparation.pyramid import THIRD, build_clip_target
from lang3dxl_ns.preparation.regions import RegionSource, label_size, stored_labels
from lang3dxl_ns.preparation.settings import PreparationConfig, Quality
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.targets import CLIP, DENSE, FINE, REGIONS, TargetReader
from lang3dxl_ns.preparation.workers import Workers
from lang3dxl_ns.preparation.working_photos import WorkingPhotos
from lang3dxl_ns.scene.photo import Photo

_CROP_RULE = 4
"""Increased when crops, their encoding or their average change, so that older entries are made again."""
_READERS = 2
"""Threads that read photos while others are encoded."""
_ANNOUNCED_CROPS = 5_000
"""Fewer are encoded in seconds: no duration is measured."""
_MEASURED_S = 3.0
"""Seconds in which noise is encoded, to announce a duration."""
_PATCHES_PER_CROP = 32
"""Windows of patch features are encoded this many times fewer at once than crops: they hold more."""
_LONG_S = 1800.0
"""Seconds on a CPU from which the remedies are named."""


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
    crops: Crops
    fast: int
    """Crops that `--quality fast` would take."""
    clip: dict[str, Any] | None
    dense: dict[str, Any] | None
    regions: dict[str, Any] | None
    has_dense: bool
    has_regions: bool
    is_fine: bool = False
    """Whether the crops are small ones alone, on a finer grid."""
    grids: tuple[Grid, Grid] | None = None
    """Grids of a map of patch features, which then takes the place of crops."""

    @property
    def clip_kind(self) -> str:
        return FINE if self.is_fine else CLIP

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
    clip_model = find_model(config.clip, CLIP_OPTION)
    input_pixels = input_side(clip_model.folder)
    patches = patch_reading(config.clip, config.clip_features)
    dense_model = None if not config.makes_dense else find_model(config.dense, DENSE_OPTION).identity

    def crops_of(photo: Photo, quality: Quality) -> Crops:
        pixel_size = 1 / photo.width if pixel_sizes is None else pixel_sizes[photo.name]
        size = photo.width, photo.height
        return choose_crops(scales, pixel_size, size, photo.name in fine, input_pixels, quality)

    tasks = []
    for photo, content in zip(photos, store.photo_hashes(photos).values(), strict=True):
        if isinstance(content, UserError):
            left_out[photo.name] = str(content)
            continue
        source, is_fine = _source(photo, content), photo.name in fine
        crops = crops_of(photo, config.quality)
        fast = crops_of(photo, "fast").count(photo.height, photo.width)
        clip = {**source, "encoder": clip_model.identity, "crop_sides": crops.sides, "rule": _CROP_RULE}
        if is_fine and crops.steps != THIRD:
            clip["steps"] = crops.steps
        grids = None
        if patches is not None:
            grids = map_grids(photo.height, photo.width, patches.tokens, config.dense_tokens)
            sides = sorted(math.ceil(photo.width / columns) for _, columns in grids)
            clip = {**source, "encoder": clip_model.identity, "crop_sides": sides}
            clip |= {"patches": patches.recipe, "grids": grids, "rule": RULE}
        has_dense = dense_model is not None and (is_fine or not fine)
        dense = {**source, "encoder": dense_model, "tokens": config.dense_tokens} if has_dense else None
        labels = None if regions is None else regions.settings(photo)
        settings = None if labels is None else {**source, **labels}
        has_regions = labels is not None
        task = _Task(photo, crops, fast, clip, dense, settings, has_dense, has_regions, is_fine, grids)
        task.drop_current(store)
        tasks.append(task)
    without = [task.photo.name for task in tasks if not task.has_regions]
    if regions is not None and without:
        say(f"{len(without)} of {len(tasks)} photos have no regions: {some(without)}")
    return tasks


def _source(photo: Photo, content: str) -> dict[str, Any]:
    """Everything that determines the photo as it is read. The camera matters only if it undistorts."""
    lens = photo.lens
    camera = [lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion, lens.fisheye] if lens.distorts else None
    source = {"photo": content, "size": [photo.width, photo.height], "undistorted": camera}
    return {**source, "turned": photo.quarter_turns} if photo.quarter_turns else source


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
    maker = _Maker(config, store, regions, with_clip, with_dense, missing)
    store.remove_leftovers()
    clip, dense = maker.models(str(device))
    _announce(missing, photos, clip, dense, config, store)
    if clip:
        _announce_duration(missing, clip, dense, config, torch.device(device))
    workers = Workers(config.workers, config.engine, config.address)
    with progress("encoding photos", len(missing)) as advance:
        for task, trouble in workers.run(maker, missing, str(device)):
            if trouble:
                left_out[task.photo.name] = trouble
            advance()


class _ReadAhead:
    """Reads the photos of tasks in threads, a few before their turn."""

    def __init__(self, read: Callable[[Photo], UInt8[Tensor, "h w 3"]], tasks: Sequence[_Task]) -> None:
        self._read, self._waiting = read, deque(tasks)
        self._pool = ThreadPoolExecutor(_READERS, thread_name_prefix="photo-reader")
        self._read_by_name: dict[str, Future[UInt8[Tensor, "h w 3"]]] = {}

    def get(self, photo: Photo) -> UInt8[Tensor, "h w 3"]:
        """The photo's pixels. Raises UserError if it can't be read."""
        while self._waiting and len(self._read_by_name) <= _READERS:
            ahead = self._waiting.popleft().photo
            self._read_by_name[ahead.name] = self._pool.submit(self._read, ahead)
        future = self._read_by_name.pop(photo.name, None)
        return self._read(photo) if future is None else future.result()


@dataclass
class _Maker:
    """Setup of a worker that makes entries."""

    config: PreparationConfig
    store: FeatureStore
    regions: RegionSource | None
    with_clip: bool
    with_dense: bool
    tasks: list[_Task]
    """In their order, to be read ahead; a worker process doesn't know which it gets."""
    _models: tuple[ImageTextEncoder | None, DenseEncoder | None] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "tasks": [], "_models": None}  # every process loads its own

    def models(self, device: str) -> tuple[ImageTextEncoder | None, DenseEncoder | None]:
        """The encoders needed; loaded once."""
        if self._models is None:
            c = self.config
            clip = load_image_text_encoder(c.clip, device) if self.with_clip else None
            dense = load_dense_encoder(c.dense, device, c.dense_tokens) if self.with_dense else None
            self._models = clip, dense
        return self._models

    def start(self, device: str) -> Callable[[_Task], str | None]:
        """As `workers.Maker.start`. The work returns why a photo can't be used, or None."""
        clip, dense = self.models(device)
        photos = _ReadAhead(WorkingPhotos(self.store).read, self.tasks)

        def work(task: _Task) -> str | None:
            try:
                pixels = photos.get(task.photo)
            except UserError as error:
                return str(error)
            image = pixels.to(device).float() / 255  # a quarter of the bytes travel to a GPU
            _encode(task, image, clip, dense, self.regions, self.config.crop_batch, self.store)
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
            task.crops.sides,
            clip.encode_images,
            clip.crop_size,
            crop_batch,
            task.crops.steps,
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
            grid = task.grids[-1] if task.grids else task.crops.grid(task.photo.height, task.photo.width)
            total += 2 * math.prod(grid) * (clip.dim + 1)
        if task.dense and dense:
            total += 2 * dense.tokens**2 * dense.dim
        if task.regions:
            total += 2 * math.prod(label_size(task.photo.height, task.photo.width))
    return total


def _announce_duration(
    missing: list[_Task],
    clip: ImageTextEncoder,
    dense: DenseEncoder | None,
    config: PreparationConfig,
    device: torch.device,
) -> None:
    """Log how many crops are encoded, and for how long, by the time that noise takes."""
    tasks = [task for task in missing if task.clip and not task.grids]
    crops = sum(task.crops.count(task.photo.height, task.photo.width) for task in tasks)
    if crops < _ANNOUNCED_CROPS:
        return
    noise = torch.rand(3, clip.crop_size, clip.crop_size, device=device)
    of_crop = _seconds_each(
        lambda batch: clip.encode_images(noise.expand(batch, -1, -1, -1)), config.crop_batch
    )
    rest = 0.0
    if dense is not None:
        encoder, photo = dense, noise.permute(1, 2, 0)
        rest = sum(task.dense is not None for task in tasks) * _seconds_each(
            lambda _: encoder.encode(photo), 1
        )
    takes, faster = ((n * of_crop + rest) / config.workers for n in (crops, sum(task.fast for task in tasks)))
    quality = spoken("--pipeline.datamanager.quality")
    hint = "" if faster > 0.9 * takes else f"; {quality} fast: {_duration(faster)}"
    say(f"{len(tasks):,} photos, {crops:,} crops with {config.clip}: about {_duration(takes)}{hint}")
    if device.type == "cpu" and takes > _LONG_S:
        remedies = ["a GPU (some hundred times)", *([f"{quality} fast"] if hint else [])]
        if config.clip != BUILTIN:
            remedies.append(f"{spoken(CLIP_OPTION)} builtin if its words suffice")
        remedies.append("fewer photos")
        say(
            f"That is long, since this runs on the CPU. What shortens it: {', '.join(remedies)}. It can be "
            "stopped at any time and goes on where it was"
        )


def _seconds_each(work: Callable[[int], Tensor], most: int) -> float:
    """Seconds that one of a batch takes, once all is warm. Batches grow up to `most` while that is quick: on
    a busy machine threads wait for each other in every layer, which costs a small batch as much as a large
    one."""
    size, taken = 1, 0.0
    work(size).cpu()  # waits for a GPU
    while True:
        start = time.perf_counter()
        work(size).cpu()
        seconds = time.perf_counter() - start
        taken += seconds
        if size == most or taken > _MEASURED_S:
            return seconds / size
        size = min(4 * size, most)


def _duration(seconds: float) -> str:
    """A duration to two digits at most."""
    if seconds < 1.5:
        return "a second"
    if seconds < 90:
        return f"{round(seconds)} seconds"
    return f"{round(seconds / 60)} minutes" if seconds < 5400 else f"{seconds / 3600:.1f} hours"


def _announce(
    missing: list[_Task],
    photos: int,
    clip: ImageTextEncoder | None,
    dense: DenseEncoder | None,
    config: PreparationConfig,
    store: FeatureStore,
) -> None:
    """Log the work ahead, and the disk and memory it needs. Raises UserError if the disk is too small."""
    needed, crop_size = _bytes_needed(missing, clip, dense), clip.crop_size if clip else 0
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
