"""Makes the targets of a scene: CLIP grids, dense features and regions, one photo after the other.

Every entry carries the settings that made it. A second run makes only what is missing or was made with other
settings, so a run that was stopped, at any moment, is simply started again.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.preparation.encoders import (
    CLIP_OPTION,
    DENSE_OPTION,
    DenseEncoder,
    ImageTextEncoder,
    find_model,
    load_dense_encoder,
    load_image_text_encoder,
)
from lang3dxl_ns.preparation.photo import Photo
from lang3dxl_ns.preparation.physical_scale import AngleRule, DistanceRule, crop_sides
from lang3dxl_ns.preparation.progress import progress, say, some
from lang3dxl_ns.preparation.pyramid import build_clip_target, crop_centres
from lang3dxl_ns.preparation.regions import RegionLevel, RegionSource, label_size, stored_labels
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.targets import CLIP, DENSE, REGIONS, TargetReader
from lang3dxl_ns.preparation.workers import Workers

_CROP_RULE = 1
"""Raised when the crops or their average change: entries made by an older rule are then made again."""
_CHECKERS = 4
"""Threads."""
_PATIENCE_S = 1.0
"""Between looks at photos that another process is making."""
_BUSY = "another process is making it"


@dataclass
class PreparationConfig:
    """What the targets are made with."""

    clip: str = "openai/clip-vit-base-patch32"
    """CLIP in Hugging Face format: a name, a folder, or "builtin". Queries need the same one. The paper uses
    this architecture fine-tuned on landmarks."""
    dense: str = "facebook/dinov2-small"
    """Vision transformer whose patch tokens sharpen the field: a name, a folder, or "none" to do without."""
    scale_range: tuple[float, float] | None = None
    """Sides of the smallest and largest crop, in COLMAP units ("physical") or in photo widths ("relative").
    Left out: proposed from the scene."""
    scale_preset: str | None = None
    """Scene whose published range to use instead, such as "holyscenes/milano"."""
    scale_mode: Literal["auto", "physical", "relative"] = "auto"
    """Whether crops have one size in the world or one size in the photo. In the world, the crop that fits a
    window fits it in near and far photos; `auto`: in the world, unless the photos agree in scale anyway."""
    scales: int | None = None
    """Number of crop sizes in the range; 1 is its (geometric) middle alone. Left out: two per doubling, or 7
    where crops have no size in the world."""
    pixel_distance: DistanceRule = "median"
    """How far a photo's subject is: the camera's distance to the median of its tracked points, to their mean,
    or to the mean of those away from the edges ("mean-inner", the paper's text)."""
    pixel_angle: AngleRule = "half"
    """How much a pixel shows at that distance: 2 d tan(θ/2) ("half", which the published scale ranges belong
    to), the paper's text ("paper"), or the pinhole's d / f ("exact")."""
    dense_tokens: int = 64
    """Dense features per side of a photo, which is squashed to a square. The authors use 128: four times the
    disk and over four times the time."""
    crop_batch: int = 256
    """Crops encoded at once: more are faster on a GPU, and take more of its memory."""
    workers: int = 1
    """Processes that encode photos: on one machine, each with its own copy of the encoders and, with several
    GPUs, a GPU in turn."""
    engine: Literal["local", "ray"] = "local"
    """What runs them: this machine, or a Ray cluster that sees the same folders (extra [ray])."""
    address: str | None = None
    """Of the Ray cluster, such as auto or ray://HOST:10001. Left out: one is started on this machine."""
    foreground: str = "auto"
    """Where photos count: "auto" (masks/ in the data folder, where there is one), "none" (everywhere), "text"
    (where a model sees the prompts), or a folder of masks, white = keep, named like the photos."""
    foreground_prompts: tuple[str, ...] = ("building",)
    """What to keep with "text": all that any of the prompts names."""
    foreground_model: str = "IDEA-Research/grounding-dino-tiny"
    """What finds the prompts: a GroundingDINO, whose boxes `sam` fills, or a CLIPSeg, lighter and coarser
    (CIDAS/clipseg-rd64-refined). A name or a folder."""
    regions: str = "auto"
    """Segments inside which features should agree: "auto" (regions/ in the data folder, where there is one),
    "none", "sam", "felzenszwalb" (needs no weights), or a folder of label maps named like the photos: 16-bit
    PNG, 0 = no region, or .npy, negative = no region."""
    region_level: RegionLevel = "small"
    """Which of SAM's masks a pixel belongs to where they overlap. Small, as in the paper."""
    sam: str = "facebook/sam-vit-base"
    """SAM for regions and for boxes: a name or a folder. The authors use facebook/sam-vit-huge, several times
    as slow; label maps are too small to show much of the difference."""


@dataclass
class PreparedTargets:
    """What a preparation left behind."""

    reader: TargetReader
    """Of the photos whose targets are complete, in the order given."""
    left_out: dict[str, str]
    """Photos that could not be read, and why."""
    encoded: int
    """Photos that something was made for in this run."""


@dataclass
class _Task:
    """What a photo needs, and the settings of the entries to be made; None where there is nothing to do."""

    photo: Photo
    sides: list[int]
    scales: list[float]
    clip: dict[str, Any] | None
    dense: dict[str, Any] | None
    regions: dict[str, Any] | None
    has_regions: bool

    @property
    def is_done(self) -> bool:
        return self.clip is None and self.dense is None and self.regions is None

    def drop_current(self, store: FeatureStore) -> None:
        """Forget the entries that the store has by now."""
        for kind in (CLIP, DENSE, REGIONS):
            settings = getattr(self, kind)
            if settings is not None and store.is_current(kind, self.photo.name, settings):
                setattr(self, kind, None)


def prepare(
    photos: Sequence[Photo],
    pixel_sizes: dict[str, float] | None,
    config: PreparationConfig,
    scales: Sequence[float],
    store: FeatureStore,
    device: torch.device | str,
    regions: RegionSource | None = None,
) -> PreparedTargets:
    """Makes the missing targets of all photos and says beforehand how many, and how much disk they take.

    pixel_sizes: world units per pixel *of the photo as it is read* (its `width`), by photo name; None for
    relative scales. scales: crop sides in world units, or in photo widths without pixel sizes.
    regions: where label maps come from; None for none.

    Photos that can't be read are left out with a warning. Raises UserError when none can be read, a model
    can't be loaded, or the disk is too small.
    """
    left_out: dict[str, str] = {}
    tasks = _plan(photos, pixel_sizes, config, scales, store, regions, left_out)
    missing = [task for task in tasks if not task.is_done]
    if missing:
        _make(missing, len(tasks), config, store, device, regions, left_out)
    names = [task.photo.name for task in tasks if task.photo.name not in left_out]
    if not names:
        raise UserError("no photo can be prepared: " + ("; ".join(left_out.values()) or "the scene has none"))
    if left_out:
        say(f"left out {len(left_out)} of {len(photos)} photos:", *(f"  {why}" for why in left_out.values()))
    encoded = sum(task.photo.name not in left_out for task in missing)
    with_regions = [task.photo.name for task in tasks if task.has_regions]
    reader = TargetReader(store, names, config.dense != "none", with_regions)
    return PreparedTargets(reader, left_out, encoded)


def _plan(
    photos: Sequence[Photo],
    pixel_sizes: dict[str, float] | None,
    config: PreparationConfig,
    scales: Sequence[float],
    store: FeatureStore,
    regions: RegionSource | None,
    left_out: dict[str, str],
) -> list[_Task]:
    """A task per photo; photos whose file can't be read go to `left_out`."""
    clip_model = find_model(config.clip, CLIP_OPTION).identity
    dense_model = None if config.dense == "none" else find_model(config.dense, DENSE_OPTION).identity

    def plan_one(photo: Photo) -> _Task | UserError:
        try:
            source = _source(photo)
        except UserError as error:
            return error
        pixel_size = 1 / photo.width if pixel_sizes is None else pixel_sizes[photo.name]
        sides, sizes = crop_sides(scales, pixel_size, photo.width)
        clip = {**source, "encoder": clip_model, "crop_sides": sides, "rule": _CROP_RULE}
        dense = {**source, "encoder": dense_model, "tokens": config.dense_tokens} if dense_model else None
        labels = None if regions is None else regions.settings(photo)
        settings = None if labels is None else {**source, **labels}
        task = _Task(photo, sides, sizes, clip, dense, settings, has_regions=labels is not None)
        task.drop_current(store)
        return task

    tasks = []
    # Reading and hashing files, which threads do side by side.
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


def _source(photo: Photo) -> dict[str, Any]:
    """Everything that decides what `photo.read()` gives. The camera takes part only where it undistorts."""
    distorts = bool(photo.distortion) or photo.fisheye
    camera = [photo.fx, photo.fy, photo.cx, photo.cy, *photo.distortion, photo.fisheye] if distorts else None
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
    """Writes the missing entries, photo by photo, in as many processes as asked for."""
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
            missing, workers = busy, Workers()  # the few that another command is at: wait for it here
            if busy:
                time.sleep(_PATIENCE_S)


@dataclass
class _Maker:
    """What a worker needs to make entries."""

    config: PreparationConfig
    store: FeatureStore
    regions: RegionSource | None
    with_clip: bool
    with_dense: bool
    _models: tuple[ImageTextEncoder | None, DenseEncoder | None] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_models": None}  # every process loads its own

    def models(self, device: str) -> tuple[ImageTextEncoder | None, DenseEncoder | None]:
        """The encoders that are needed; loaded once."""
        if self._models is None:
            c = self.config
            clip = load_image_text_encoder(c.clip, device) if self.with_clip else None
            dense = load_dense_encoder(c.dense, device, c.dense_tokens) if self.with_dense else None
            self._models = clip, dense
        return self._models

    def start(self, device: str) -> Callable[[_Task], str | None]:
        """As `workers.Maker.start`. The work returns why a photo can't be used, or that another process is
        at it, or None."""
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
    if task.clip and clip:
        target = build_clip_target(
            image, task.sides, task.scales, clip.encode_images, clip.crop_size, crop_batch
        )
        tensors = {"features": target.features, "valid": target.valid}
        store.write(CLIP, task.photo.name, tensors, task.clip)
    if task.dense and dense:
        store.write(DENSE, task.photo.name, {"features": dense.encode(image)}, task.dense)
    if task.regions and regions:
        labels = stored_labels(regions.labels(task.photo, image))
        store.write(REGIONS, task.photo.name, {"labels": labels}, task.regions)


def _bytes_needed(tasks: Iterable[_Task], clip: ImageTextEncoder | None, dense: DenseEncoder | None) -> int:
    """Size of the entries to be made: two bytes per number."""
    total = 0
    for task in tasks:
        if task.clip and clip:
            rows, columns = (
                len(crop_centres(n, min(task.sides))) for n in (task.photo.height, task.photo.width)
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
    """Says what is going to be made, and what it takes. Raises UserError when the disk is too small."""
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
    """Of one process, about: the largest photo in float32, thrice (as read, padded, cut into windows), and a
    batch of crops with the first layers' activations, a dozen times its size."""
    largest = max(photo.width * photo.height for photo in photos)
    return 3 * 4 * (3 * largest + 12 * crop_pixels)


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.2f} GB"
