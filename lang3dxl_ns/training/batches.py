"""A capture prepared for training: photos with foreground, targets, facts, and one photo after the other."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import torch
from torch import Tensor

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.preparation.encoders import usual_dense
from lang3dxl_ns.preparation.foreground import with_foreground
from lang3dxl_ns.preparation.model_files import CLIP_OPTION, find_model, usual_clip
from lang3dxl_ns.preparation.needs import Need, scene_needs
from lang3dxl_ns.preparation.photo_cache import PhotoCache, has_vanished
from lang3dxl_ns.preparation.physical_scale import CropPlan, plan_crops
from lang3dxl_ns.preparation.prepare import prepare
from lang3dxl_ns.preparation.regions import RegionSource, region_source
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore, PhotosGoneError
from lang3dxl_ns.preparation.targets import Batch, SceneFacts, TargetReader, each_readable
from lang3dxl_ns.preparation.working_photos import WorkingPhotos
from lang3dxl_ns.scene.capture import Capture
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord
from lang3dxl_ns.training.state import PhotoCamera, Training

Prepared = TypeVar("Prepared", bound=PreparationConfig)
IN_A_STEP = {"clip_target": torch.float32, "dense_target": torch.float32, "regions": torch.int64}
"""Number types of targets in a step; in memory they are kept half as wide."""
MOST_GONE = 0.1
"""Share of the training photos that may vanish before training ends."""


def settled(config: Prepared, learned: bool, gathered: bool) -> Prepared:
    """Return the settings of the targets without `auto`: semantics `learned` with the scene use regions in
    every step; features `gathered` onto Gaussians, also those that codes start from, need fine crops."""
    config = replace(config, clip=usual_clip(config.clip, config.dense))
    crops, regions = config.crops, config.regions
    if crops == "auto":
        crops = "fine" if gathered else "pyramid"
    if not learned or config.clip == "none":
        regions = "none"
    dense = "none" if config.clip == "none" else usual_dense(config, learned)
    return replace(config, crops=crops, regions=regions, dense=dense)


def read_data(
    photo: Photo, working: WorkingPhotos, scale: float, targets: TargetReader | None
) -> dict[str, Any]:
    """Read a photo's data for a step as they are kept in memory: bytes and half precision. The data are
    `image` [h, w, 3] uint8, `mask` [h, w, 1] bool if any, and with targets `clip_target` [Hd, Wd, C],
    `crop_sides` (fractions of the width) and, if any, `dense_target` [t, t, D] and `regions` [h, w]
    (labels, −1 for none). Raises UserError if something can't be read."""
    data: dict[str, Any] = {"image": working.read(photo, scale)}
    if (mask := working.mask(photo, scale)) is not None:
        data["mask"] = mask[..., None]
    if targets is None:
        return data
    clip = targets.clip(photo.name)
    found = {"clip_target": clip.features, "dense_target": targets.dense(photo.name)}
    found["regions"] = targets.regions(photo.name)
    # Clone the values, so that they are read from disk now and not during the step.
    data |= {key: value.clone() for key, value in found.items() if value is not None}
    return data | {"crop_sides": clip.crop_fractions}


def to_batch(data: dict[str, Any], name: str, index: int, device: torch.device | str) -> Batch:
    """Put a photo's data on the device, with its name and its number, training photos first."""
    batch: dict[str, Any] = {"image_idx": index, "name": name}
    for key, value in data.items():
        if isinstance(value, Tensor):
            value = to_device(value, device).to(IN_A_STEP.get(key, value.dtype))
        batch[key] = value
    return cast(Batch, batch)


@dataclass(eq=False)
class TrainingData:
    """A capture's photos for training, in rounds: each round has every photo once, in random order."""

    capture: Capture
    config: PreparationConfig
    """Settings of the targets; `dense`, `crops` and `regions` are resolved."""
    cache_dir: Path
    """Folder of prepared targets."""
    device: torch.device | str
    targets_in_steps: bool
    """Whether steps learn from the targets."""
    scale: float = 1.0
    """Size of the pictures relative to the photos."""
    cache_gb: float | None = None
    """Memory for decoded photos, gigabytes; None: a quarter of the machine's."""
    read_ahead: int = 16
    """Number of photos read ahead of the training step."""
    order_seed: int = 42
    """Seed of the order of photos."""
    photo_in_hand: str = ""
    """Name of the latest training photo."""
    _left_out: set[int] = field(default_factory=set)
    _gone: int = 0

    def __post_init__(self) -> None:
        self._order = random.Random(self.order_seed)
        self._upcoming = self._round() if self.capture.split.train else []

    @cached_property
    def as_read(self) -> list[Photo]:
        """Photos of both splits, training photos first, then those that neither uses since their poses are
        contradicted, without foreground masks."""
        side = self.config.longer_side
        known = {photo.name: photo.at_most(side) for photo in self.capture.photos}
        large = sum(max(photo.width, photo.height) > side for photo in self.capture.photos)
        if large:
            say(
                f"{large} of {len(known)} photos are larger than {side:,} pixels and used at that size "
                f"({data_option('longer-side')})"
            )
        train, held_out = self.capture.split
        return [known[name] for name in dict.fromkeys((*train, *held_out, *self.capture.contradicted))]

    @cached_property
    def photos(self) -> dict[str, Photo]:
        """All photos by name, training photos first, with their foreground masks, which are made on first
        use."""
        folder, config = self.capture.folder, self.config
        links = self.capture.settings.follow_links
        masked = with_foreground(self.as_read, config, folder, self.cache_dir, self.device, links)
        return {photo.name: photo for photo in masked}

    @cached_property
    def views(self) -> dict[str, PhotoCamera]:
        """Cameras of all photos by name, training photos first, at the size of training."""
        names, count = [photo.name for photo in self.as_read], len(self.capture.split.train)
        poses = torch.from_numpy(self.capture.poses(names))
        lenses = [photo.lens.scaled(self.scale) for photo in self.as_read]
        return {
            name: PhotoCamera(pose, lens.matrix.float(), lens.width, lens.height, i if i < count else None)
            for i, (name, pose, lens) in enumerate(zip(names, poses, lenses, strict=True))
        }

    @cached_property
    def splits(self) -> dict[str, Literal["train", "eval"]]:
        """Split of each photo by name, training photos first."""
        return {name: "eval" if view.photo is None else "train" for name, view in self.views.items()}

    @cached_property
    def cameras(self) -> list[PhotoCamera]:
        """Cameras of the training photos, at the size of training."""
        return [self.views[name] for name in self.capture.split.train]

    @cached_property
    def needs(self) -> list[Need]:
        """Needs of the scene for optional parts."""
        learns, photos = self.config.clip != "none", list(self.photos.values())
        dense, regions = self.config.makes_dense, self._regions is not None
        plan, model = self.crops, self.capture.reconstruction
        return scene_needs(photos, model, plan, learns and dense, learns and regions)

    @cached_property
    def crops(self) -> CropPlan:
        """Crop sizes of the photos."""
        return plan_crops(list(self.photos.values()), self.capture.reconstruction, self.config)

    @cached_property
    def _regions(self) -> RegionSource | None:
        return region_source(self.config, self.capture.folder, self.capture.settings.follow_links)

    @cached_property
    def targets(self) -> TargetReader | None:
        """Targets of all photos, which are made on first use; None if only colors are trained."""
        if self.config.clip == "none":
            return None
        train, held_out = self.capture.split
        used = [self.photos[name] for name in dict.fromkeys((*train, *held_out))]
        fine = list(train) if self.config.crops == "fine" else []
        say(*self.crops.reasons)
        return prepare(
            used, self.crops.pixel_sizes, self.config, self.crops.scales,
            FeatureStore(self.cache_dir), self.device, self._regions, fine,
        )  # fmt: skip

    def facts(self) -> SceneFacts:
        """Return what a model is built from. Raises UserError if no training photo has targets."""
        names = list(self.capture.split.train)
        facts = SceneFacts(names, torch.stack([camera.pose[:, 3] for camera in self.cameras]))
        facts.needs = {need.component: need.needed for need in self.needs}
        if self.targets is not None:
            prepared = set(self.targets.names)  # damaged photos are missing from it
            usable = [name for name in names if name in prepared]
            if not usable:
                raise UserError("none of the training photos can be used: see the reasons above")
            facts.statistics = self.targets.feature_statistics(usable, self.targets_in_steps)
            facts.clip_targets = partial(self.targets.clip_features, usable)
            if self.targets.dense_dim:
                facts.dense_targets = partial(self.targets.dense_features, usable)
        return facts

    def record(self, run: Training | None = None) -> SceneRecord:
        """Describe photos, CLIP and cameras, as the run refined them, for a scene file."""
        known = None if self.config.clip == "none" else find_model(self.config.clip, CLIP_OPTION)
        described, doubts = [], self.capture.doubtful
        for name, view in self.views.items():
            pose = view.pose if run is None else run.pose(view)
            photo, split = self.photos[name], self.splits[name]
            described.append(ScenePhoto.of(photo, split, pose.tolist(), self.scale, doubts.get(name)))
        frame = self.capture.recorded_frame
        return SceneRecord(
            photos=described,
            clip=None if known is None else known.address,
            clip_identity=None if known is None else known.clip_identity,
            scale=frame.scale,
            transform=frame.transform.tolist(),
            data=str(self.capture.folder),
        ).located(self.photos.values())

    # ── rounds ──────────────────────────────────────────────────────────────────────────────────────

    @cached_property
    def working(self) -> WorkingPhotos:
        """Reader of the photos, which keeps copies of large ones."""
        return WorkingPhotos(FeatureStore(self.cache_dir))

    @cached_property
    def _cache(self) -> PhotoCache:
        targets = self.targets if self.targets_in_steps else None  # prepared now, not in the cache's thread
        photos = [self.photos[name] for name in self.capture.split.train]

        def read(index: int) -> dict[str, Any]:
            return read_data(photos[index], self.working, self.scale, targets)

        return PhotoCache(read, machine_memory() / 4 if self.cache_gb is None else self.cache_gb * 1e9)

    def _round(self) -> list[int]:
        order = list(range(len(self.capture.split.train)))
        self._order.shuffle(order)
        if not (usable := [i for i in order if i not in self._left_out]):
            raise UserError("none of the training photos can be used: see the reasons above")
        return usable

    def next(self) -> tuple[PhotoCamera, Batch]:
        """Return camera and batch of the next training photo. A photo found to be damaged is left out from
        then on. Raises PhotosGoneError if too many have vanished."""
        while True:
            index = self._upcoming.pop(0)
            self._upcoming = self._upcoming or self._round()
            name = self.capture.split.train[index]
            try:
                data = self._cache.get(index, self._upcoming[: self.read_ahead])
            except PhotosGoneError:
                raise
            except UserError as reason:
                say(f"{name} is left out of training: {reason}")
                self._leave_out(index, reason)
                self._upcoming = [i for i in self._upcoming if i != index] or self._round()
                continue
            self.photo_in_hand = name
            return self.cameras[index], to_batch(data, name, index, self.device)

    def _leave_out(self, index: int, reason: UserError) -> None:
        self._left_out.add(index)
        self._gone += has_vanished(reason)
        count = len(self.capture.split.train)
        if self._gone > max(MOST_GONE * count, 1):
            raise PhotosGoneError(
                f"{self._gone} of {count} training photos or their targets have vanished; "
                f"the latest reason: {reason}; restore the disk or network share"
            ) from reason

    def every_photo(self) -> Iterator[tuple[PhotoCamera, Batch]]:
        """Yield camera and batch, with targets, of every training photo once, without the damaged ones.
        Raises UserError if none can be read."""
        names = self.capture.split.train
        return self.read(name for i, name in enumerate(names) if i not in self._left_out)

    def read(self, names: Iterable[str]) -> Iterator[tuple[PhotoCamera, Batch]]:
        """Yield camera and batch, with targets, of photos by name, one in memory at a time. Damaged ones are
        left out, with a message. Raises UserError if none can be read."""
        targets, number, usable = self.targets, {name: i for i, name in enumerate(self.views)}, False

        def read_one(name: str) -> dict[str, Any]:
            return read_data(self.photos[name], self.working, self.scale, targets)

        for name, data in each_readable(read_one, names):
            usable = True
            yield self.views[name], to_batch(data, name, number[name], self.device)
        if not usable:
            raise UserError("none of the photos can be used: see the reasons above")

    def state(self) -> dict[str, Any]:
        """Return the photos left in this round, and the state that determines the next, for a checkpoint."""
        names = [self.capture.split.train[i] for i in self._upcoming]
        return {"upcoming": names, "generator": self._order.getstate()}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore `state`. Photos that this run lacks are skipped; new ones join in the next round."""
        index = {name: i for i, name in enumerate(self.capture.split.train)}
        self._order.setstate(state["generator"])
        self._upcoming = [index[name] for name in state["upcoming"] if name in index] or self._round()
