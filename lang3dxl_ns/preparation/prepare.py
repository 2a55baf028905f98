"""Makes and reads the targets of a scene: CLIP grids, dense features and regions, one photo after the other.

Every entry carries the settings that made it. A second run makes only what is missing or was made with other
settings, so a run that was stopped, at any moment, is simply started again.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
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

CLIP, DENSE, REGIONS = "clip", "dense", "regions"

_CROP_RULE = 1
"""Raised when the crops or their average change: entries made by an older rule are then made again."""
_STD_FLOOR = 0.01


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
    single_scale: bool = False
    """Crops of one size alone, the (geometric) middle of the range."""
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
class StoredClipTarget:
    """A photo's CLIP target, mapped from disk: float16, CPU."""

    features: Float[Tensor, "hd wd c"]
    """Mean embedding over the scales, not normalised."""
    valid: Float[Tensor, "hd wd"]
    """Mean fraction of the crops' area inside the photo, 0…1."""
    crop_fractions: list[float]
    """Crop sides as fractions of the photo's width, ascending."""

    @property
    def range_factor(self) -> float:
        """Largest over smallest crop."""
        return self.crop_fractions[-1] / self.crop_fractions[0]


@dataclass
class ChannelStatistics:
    """Mean and standard deviation per channel; the deviation is floored at 1 % of the channels' average."""

    mean: Float[Tensor, " c"]
    std: Float[Tensor, " c"]


@dataclass
class FeatureStatistics:
    """Of the CLIP and the dense targets, for whitening the field's output."""

    clip: ChannelStatistics
    dense: ChannelStatistics | None


class TargetReader:
    """The prepared targets of a scene's photos, by photo name; nothing is loaded before it is touched."""

    def __init__(
        self,
        store: FeatureStore,
        names: Sequence[str],
        with_dense: bool = True,
        with_regions: Collection[str] = (),
    ) -> None:
        self.names = list(names)
        self._store, self._with_dense, self._with_regions = store, with_dense, frozenset(with_regions)
        self.clip_dim: int = store.shapes(CLIP, self.names[0])["features"][-1]
        self.dense_dim: int = store.shapes(DENSE, self.names[0])["features"][-1] if with_dense else 0

    def clip(self, name: str) -> StoredClipTarget:
        """The CLIP target of a photo. Raises UserError when it isn't prepared."""
        settings = self._store.settings(CLIP, name)
        width = settings["size"][0]
        return StoredClipTarget(
            **self._store.read(CLIP, name), crop_fractions=[side / width for side in settings["crop_sides"]]
        )

    def clip_features(self, names: Iterable[str]) -> Iterator[Float[Tensor, "hd wd c"]]:
        """The CLIP targets of photos, one at a time, float16."""
        return (self.clip(name).features for name in names)

    def dense(self, name: str) -> Float[Tensor, "t t d"] | None:
        """The dense features of the squashed photo, float16; None when prepared without."""
        return self._store.read(DENSE, name)["features"] if self._with_dense else None

    def regions(self, name: str) -> Int[Tensor, "h w"] | None:
        """Region labels of the photo, −1 for none; None (and nothing is read) for a photo without regions."""
        return self._store.read(REGIONS, name)["labels"] if name in self._with_regions else None

    def check(self, encoder: ImageTextEncoder) -> None:
        """Raises UserError when a photo's target is missing or comes from another CLIP than `encoder`."""
        for name in self.names:
            width = self._store.shapes(CLIP, name)["features"][-1]
            made_with = self._store.settings(CLIP, name)["encoder"]
            if (width, made_with) != (encoder.dim, encoder.identity):
                raise UserError(
                    f"the target of {name} has {width} channels and was made with another CLIP ({made_with}) "
                    f"than the one in use, which has {encoder.dim} ({encoder.identity}): run "
                    f"`lang3dxl prepare` again, or give {CLIP_OPTION} the model that made the targets"
                )

    def feature_statistics(self, names: Sequence[str] | None = None, sample: int = 100) -> FeatureStatistics:
        """Mean and deviation per channel over at most `sample` photos, evenly spaced in `names` (or all)."""
        names = self.names if names is None else list(names)
        names = names[:: -(-len(names) // sample)]
        clip = _statistics(self.clip(name).features for name in names)
        dense = (
            _statistics(self._store.read(DENSE, name)["features"] for name in names)
            if self._with_dense
            else None
        )
        return FeatureStatistics(clip, dense)


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
    """What a photo needs, and the settings of the entries to be made; None where the entry is current."""

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
    tasks = []
    with progress("checking photos", len(photos)) as advance:
        for photo in photos:
            advance()
            try:
                source = _source(photo)
            except UserError as error:
                left_out[photo.name] = str(error)
                continue
            pixel_size = 1 / photo.width if pixel_sizes is None else pixel_sizes[photo.name]
            sides, sizes = crop_sides(scales, pixel_size, photo.width)
            clip = {**source, "encoder": clip_model, "crop_sides": sides, "rule": _CROP_RULE}
            dense = {**source, "encoder": dense_model, "tokens": config.dense_tokens}
            labels = None if regions is None else regions.settings(photo)
            task = _Task(photo, sides, sizes, None, None, None, has_regions=labels is not None)
            if not store.is_current(CLIP, photo.name, clip):
                task.clip = clip
            if dense_model and not store.is_current(DENSE, photo.name, dense):
                task.dense = dense
            if labels is not None and not store.is_current(REGIONS, photo.name, {**source, **labels}):
                task.regions = {**source, **labels}
            tasks.append(task)
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
    """Loads the models that are needed and writes the missing entries, photo by photo."""
    with_clip, with_dense = any(task.clip for task in missing), any(task.dense for task in missing)
    clip = load_image_text_encoder(config.clip, device) if with_clip else None
    dense = load_dense_encoder(config.dense, device, config.dense_tokens) if with_dense else None
    store.remove_leftovers()
    _announce(missing, photos, _bytes_needed(missing, clip, dense), store)
    with progress("encoding photos", len(missing)) as advance:
        for task in missing:
            try:
                image = task.photo.read()  # once for all kinds
            except UserError as error:
                left_out[task.photo.name] = str(error)
            else:
                _encode(task, image.to(device), clip, dense, regions, config.crop_batch, store)
            advance()


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


def _announce(missing: list[_Task], photos: int, needed: int, store: FeatureStore) -> None:
    """Says what is going to be made. Raises UserError when the disk is too small for it."""
    store.root.mkdir(parents=True, exist_ok=True)
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


def _statistics(maps: Iterable[Float[Tensor, "h w c"]]) -> ChannelStatistics:
    """Statistics over all pixels of all maps, merged map by map in float64 (Chan, Golub & LeVeque 1983)."""
    count, mean, squares = 0, torch.zeros(()), torch.zeros(())
    for values in maps:
        pixels = values.flatten(0, 1).double()
        variance, own_mean = torch.var_mean(pixels, dim=0, correction=0)
        both = count + len(pixels)
        step = own_mean - mean
        mean = mean + step * len(pixels) / both
        squares = squares + variance * len(pixels) + step**2 * count * len(pixels) / both
        count = both
    std = (squares / count).sqrt()
    floor = max(_STD_FLOOR * float(std.mean()), torch.finfo(torch.float32).eps)
    return ChannelStatistics(mean.float(), std.clamp_min(floor).float())


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.2f} GB"
