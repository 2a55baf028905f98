"""Preparation of a scene's targets: CLIP grids, dense features and regions, photo by photo.

Every entry stores the settings that it was made with. A second run makes only entries that are missing or
were made with other settings, so an interrupted run can simply be repeated.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.common import parallel
from lang3dxl_ns.common.console import gigabytes, say, some, tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import check_room
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.common.stages import roughly
from lang3dxl_ns.preparation.encoders import patch_reading
from lang3dxl_ns.preparation.families import input_side
from lang3dxl_ns.preparation.kinds import Networks, Sources, Target
from lang3dxl_ns.preparation.model_files import (
    BUILTIN,
    CLIP_OPTION,
    DENSE_OPTION,
    USUAL_CLIP,
    find_model,
    read_config,
)
from lang3dxl_ns.preparation.photo_cache import PhotoCache
from lang3dxl_ns.preparation.pyramid import Crops, choose_crops
from lang3dxl_ns.preparation.regions import RegionSource
from lang3dxl_ns.preparation.settings import PreparationConfig, Quality
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.targets import CLIP, DENSE, FINE, REGIONS, TargetReader
from lang3dxl_ns.preparation.working_photos import WorkingPhotos
from lang3dxl_ns.scene.photo import Photo

_READERS = 2
"""Threads that read photos while others are encoded."""
_ANNOUNCED_CROPS = 5_000
"""Smallest number of crops whose duration is measured and announced. Fewer are encoded in seconds."""
_MEASURED_S = 3.0
"""Seconds after which the measurement with noise ends, which is the basis of the announced duration."""
_BYTES = 2
"""Bytes of a stored number."""
_LONG_S = 1800.0
"""Duration on a CPU, in seconds, above which ways to shorten it are suggested."""


@dataclass(frozen=True)
class _Task:
    """A photo, its targets, and those that are still to be made."""

    photo: Photo
    targets: list[Target]
    missing: list[Target]


def prepare(
    photos: Sequence[Photo],
    pixel_sizes: dict[str, float] | None,
    config: PreparationConfig,
    scales: Sequence[float],
    store: FeatureStore,
    device: torch.device | str,
    regions: RegionSource | None = None,
    fine: Collection[str] = (),
) -> TargetReader:
    """Make the missing targets of all photos, and return the reader of those that are complete, in the order
    given. The work ahead and the disk it needs are logged first. Photos that cannot be read are left out with
    a warning. Raises UserError if none can be read, a model cannot be loaded, or the disk is too small.

    pixel_sizes: world units per pixel *of the photo as it is read* (its `width`), by photo name; None for
    relative scales. scales: crop sides in world units, or in photo widths without pixel sizes. fine: names of
    photos that get small crops alone (`choose_crops`) or, if the encoder has a head for patches, the map that
    it reads. If any photo is fine, only fine ones get dense features.
    """
    tasks, left_out = _plan(photos, pixel_sizes, config, scales, store, regions, frozenset(fine))
    missing = [task for task in tasks if task.missing]
    if missing:
        maker = _Maker(config, store, regions, missing)
        store.remove_leftovers()
        if config.clip == BUILTIN:
            say(
                "Using the built-in CLIP, which knows landmarks and street façades and nothing else. For any "
                f"word: {data_option('clip')} {USUAL_CLIP} (a download of 600 MB)"
            )
        maker.announce(len(tasks), str(device))
        made = parallel.run(config, maker.start, missing, str(device))
        for task, trouble in tracked(made, "encoding photos", len(missing)):
            if trouble:
                left_out[task.photo.name] = trouble
    made_with = {
        task.photo.name: {target.kind: target.recipe for target in task.targets}
        for task in tasks
        if task.photo.name not in left_out
    }
    if not made_with:
        first = next(iter(left_out.values()), "the scene has none")
        raise UserError(f"no photo can be prepared; the first of {len(photos)}: {first}")
    if left_out:
        say(f"left out {len(left_out)} of {len(photos)} photos:", *(f"  {why}" for why in left_out.values()))
    return TargetReader(store, made_with)


def _plan(
    photos: Sequence[Photo],
    pixel_sizes: dict[str, float] | None,
    config: PreparationConfig,
    scales: Sequence[float],
    store: FeatureStore,
    regions: RegionSource | None,
    fine: Collection[str],
) -> tuple[list[_Task], dict[str, str]]:
    """Plan a task per photo, and collect the reasons for photos that cannot be read."""
    clip = find_model(config.clip, CLIP_OPTION)
    patches = patch_reading(config.clip, config.clip_features)
    dense = find_model(config.dense, DENSE_OPTION).identity if config.makes_dense else None
    sources = Sources(clip.identity, patches, dense, config.dense_tokens, regions, fine)
    input_pixels = input_side(read_config(clip).vision_config)

    def crops(photo: Photo, quality: Quality) -> Crops:
        pixel_size = 1 / photo.width if pixel_sizes is None else pixel_sizes[photo.name]
        size = photo.width, photo.height
        return choose_crops(scales, pixel_size, size, photo.name in fine, input_pixels, quality)

    tasks, left_out = [], {}
    for photo, content in zip(photos, store.photo_hashes(photos).values(), strict=True):
        if isinstance(content, UserError):
            left_out[photo.name] = str(content)
            continue
        asked, fast = crops(photo, config.quality), crops(photo, "fast")
        targets = list(sources.targets_of(photo, content, asked, fast))
        missing = [t for t in targets if not store.is_current(t.kind, photo.name, t.recipe)]
        tasks.append(_Task(photo, targets, missing))
    without = [t.photo.name for t in tasks if all(target.kind != REGIONS for target in t.targets)]
    if regions is not None and without:
        say(f"{len(without)} of {len(tasks)} photos have no regions: {some(without)}")
    return tasks, left_out


class _Maker:
    """Setup of a worker that makes entries."""

    def __init__(
        self, config: PreparationConfig, store: FeatureStore, regions: RegionSource | None, tasks: list[_Task]
    ) -> None:
        self._config, self._store, self._regions, self._tasks = config, store, regions, tasks
        self._kinds = {target.kind for task in tasks for target in task.missing}
        self._loaded: Networks | None = None

    def __getstate__(self) -> dict[str, Any]:
        # A process loads its own networks, and does not know which photos it will get.
        return {**self.__dict__, "_tasks": [], "_loaded": None}

    def networks(self, device: str) -> Networks:
        """Load the encoders that are needed, on the first call only."""
        if self._loaded is None:
            self._loaded = Networks(self._config, self._regions, device)
            self._loaded.load(self._kinds)
        return self._loaded

    def start(self, device: str) -> Callable[[_Task], str | None]:
        """Start a worker, as a `parallel.Start`. The work returns why a photo cannot be read, or None."""
        networks = self.networks(device)
        photos, waiting = WorkingPhotos(self._store), deque(task.photo for task in self._tasks)
        ahead = PhotoCache(lambda photo: {"image": photos.read(photo)}, 0, _READERS, patient=False)

        def work(task: _Task) -> str | None:
            if waiting:
                waiting.popleft()
            try:
                pixels = ahead.get(task.photo, list(islice(waiting, _READERS)))["image"]
            except UserError as error:
                return str(error)
            image = pixels.to(device).float() / 255  # as bytes, a quarter of the data is copied to a GPU
            for target in task.missing:
                self._store.write(target.kind, task.photo.name, target.make(image, networks), target.recipe)
            return None

        return work

    def announce(self, photos: int, device: str) -> None:
        """Log the work ahead and the disk, memory and time it needs. Raises UserError if the disk is too
        small."""
        networks, store, config, tasks = self.networks(device), self._store, self._config, self._tasks
        targets = [target for task in tasks for target in task.missing]
        needed = _BYTES * sum(target.numbers(networks) for target in targets)
        crop_size = networks.clip.crop_size if {CLIP, FINE} & self._kinds else 0
        store.make_folder()
        remedy = "use a larger smallest crop (scale range) or fewer dense tokens"
        free = check_room(store.root, needed, f"the targets of {len(tasks)} photos", remedy)
        # A process holds the largest photo in float32 three times (as read, padded, in windows), and a batch
        # of crops with the first layers' activations, which take a dozen times its size.
        largest = max(task.photo.width * task.photo.height for task in tasks)
        memory = config.workers * 3 * 4 * (3 * largest + 12 * config.crop_batch * crop_size**2)
        split = f" in {config.workers} processes" if config.workers > 1 else ""
        replaced = sum(any(store.path(m.kind, t.photo.name).exists() for m in t.missing) for t in tasks)
        if replaced:
            say(
                f"targets of {replaced} photos were made with other settings, or of other files, and are "
                f"replaced: {data_option('cache-dir')} keeps both"
            )
        say(
            f"preparing {len(tasks)} photos ({photos - len(tasks)} of {photos} are ready): "
            f"{gigabytes(needed)} in {store.root}, {gigabytes(free)} are free",
            f"memory beside the encoders: about {gigabytes(memory)}{split}, however many photos there are",
        )
        if crop_size:
            self._announce_duration(networks, torch.device(device), targets)

    def _announce_duration(self, networks: Networks, device: torch.device, targets: Sequence[Target]) -> None:
        """Log how many crops, or windows of a map, will be encoded, and an estimate of the duration, measured
        with noise."""
        config, clip = self._config, networks.clip
        counts = [count for count in (target.pictures(networks) for target in targets) if any(count)]
        encoded, fewest = (sum(numbers) for numbers in zip(*counts, strict=True))
        if encoded < _ANNOUNCED_CROPS:
            return
        noise, rest = torch.rand(1, 3, clip.crop_size, clip.crop_size, device=device), 0.0
        of_crop = _seconds_each(lambda n: clip.encode_images(noise.expand(n, -1, -1, -1)), config.crop_batch)
        if mapped := sum(target.kind == DENSE for target in targets):
            rest = mapped * _seconds_each(lambda _: networks.dense.encode(noise[0].permute(1, 2, 0)), 1)
        takes, faster = ((n * of_crop + rest) / config.workers for n in (encoded, fewest))
        quality = data_option("quality")
        hint = "" if faster > 0.9 * takes else f"; {quality} fast: {roughly(faster)}"
        say(f"{len(counts):,} photos, {encoded:,} crops with {config.clip}: {roughly(takes)}{hint}")
        if device.type == "cpu" and takes > _LONG_S:
            remedies = ["a GPU (about a hundred times faster)", *([f"{quality} fast"] if hint else [])]
            if config.clip != BUILTIN:
                remedies.append(f"{data_option('clip')} builtin if its words suffice")
            say(
                f"This is slow on a CPU. To speed it up: {', '.join([*remedies, 'fewer photos'])}. You can "
                "stop it at any time; the same command resumes it"
            )


def _seconds_each(work: Callable[[int], Tensor], most: int) -> float:
    """Measure the seconds per item of a batch, after a warm-up. Batches grow up to `most` while they are
    quick, since a small batch can take as long as a large one on a busy machine, where threads wait for each
    other in every layer."""
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
