"""Hands the trainer one photo at a time with its targets, out of core: read ahead, in a bounded cache."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import torch
import tyro
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
)
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markdown import Markdown
from rich.markup import escape
from torch import Tensor

from lang3dxl_ns.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.memory import machine_memory
from lang3dxl_ns.older_config import ReadsOlder
from lang3dxl_ns.other_scenes import photos_of, reconstruction_of
from lang3dxl_ns.photo_cache import PhotoCache
from lang3dxl_ns.preparation.collection import plan_crops, prepare_collection
from lang3dxl_ns.preparation.foreground import FOREGROUND, with_foreground
from lang3dxl_ns.preparation.photo import Photo, scaled_size
from lang3dxl_ns.preparation.physical_scale import Reconstruction
from lang3dxl_ns.preparation.prepare import PreparationConfig
from lang3dxl_ns.preparation.regions import RegionSource, region_source
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.targets import CLIP, DENSE, REGIONS, TargetReader
from lang3dxl_ns.recorded_scene import recorded_scene
from lang3dxl_ns.scene_needs import Need, Sources, needs_table, scene_needs
from lang3dxl_ns.timing import part


@dataclass
class Lang3DXLDataManagerConfig(ReadsOlder, PreparationConfig, FullImageDatamanagerConfig):
    """Photos and their targets. `--pipeline.datamanager.clip none` trains colours only."""

    _target: type = field(default_factory=lambda: Lang3DXLDataManager)
    dataparser: AnnotatedDataParserUnion = field(default_factory=PhotoCollectionDataParserConfig)
    """Where photos and cameras come from."""
    cache_dir: Path | None = None
    """Where prepared targets are kept (default: lang3dxl_cache inside the data folder)."""
    cache_gb: float | None = None
    """Memory for decoded photos and their targets, in gigabytes; the least recently used ones make room.
    Left out: a quarter of the machine's memory."""
    read_ahead: int = 4
    """Photos read ahead of the training step, on top of that memory."""
    run: tyro.conf.Suppress[Path | None] = None
    """Folder of the run whose config.yml this comes from; set as that is read."""


class PhotoDataset(InputDataset):
    """nerfstudio's dataset over `Photo`s: read, undistorted and resized on demand, pinhole cameras."""

    def __init__(self, outputs: DataparserOutputs, scale: float):
        super().__init__(outputs)
        self.scale = scale
        self.photos: list[Photo] = outputs.metadata["photos"]
        self.cameras = pinhole_cameras(self.photos, outputs.cameras, scale)

    def read(self, index: int) -> dict[str, Tensor]:
        """`image` [h, w, 3] uint8 and, where the photo has one, `mask` [h, w, 1] bool."""
        photo = self.photos[index]
        data = {"image": photo.read_uint8(self.scale)}
        mask = photo.read_mask(self.scale)
        if mask is not None:
            data["mask"] = mask[..., None]
        return data

    def get_data(self, image_idx: int, image_type: str = "float32") -> dict:
        data = self.read(image_idx)
        if image_type == "float32":
            data["image"] = data["image"].float() / 255
        return {"image_idx": image_idx, **data}

    def get_image_float32(self, image_idx: int) -> Float[Tensor, "h w 3"]:
        return self.photos[image_idx].read(self.scale)


class Lang3DXLDataManager(FullImageDatamanager):
    """One photo a step: camera, image, mask, and the targets of the semantic losses."""

    config: Lang3DXLDataManagerConfig
    train_dataset: PhotoDataset
    eval_dataset: PhotoDataset
    photo_in_hand: str
    """Name of the photo that training had last."""

    def __init__(self, config: Lang3DXLDataManagerConfig, *args, **kwargs):
        self._left_out: set[int] = set()
        if hasattr(config.dataparser, "load_3D_points"):
            config.dataparser.load_3D_points = True  # nerfstudio-data leaves them out by default
        try:
            super().__init__(config, *args, **kwargs)
        except (UserError, OSError) as reason:
            recorded = recorded_scene(config.run)
            if recorded is None or kwargs.get("test_mode", "val") == "val":
                raise
            CONSOLE.log(
                f"[yellow]The cameras are taken from the run's folder, since the photos are gone: {reason}"
            )
            config.dataparser, config.camera_res_scale_factor = recorded, 1.0
            super().__init__(config, *args, **kwargs)

    def create_train_dataset(self) -> PhotoDataset:
        return self._dataset(self.train_dataparser_outputs)

    def create_eval_dataset(self) -> PhotoDataset:
        return self._dataset(self.dataparser.get_dataparser_outputs(split=self.test_split))

    def _dataset(self, outputs: DataparserOutputs) -> PhotoDataset:
        if "photos" not in outputs.metadata:  # one of nerfstudio's own dataparsers
            outputs.metadata["photos"] = photos_of(outputs, Path(self.config.dataparser.data))
        return PhotoDataset(outputs, self.config.camera_res_scale_factor)

    def setup_train(self) -> None:
        """Before training, prepare what is missing and tell the model what there is to learn, and what the
        scene needs."""
        if self.test_mode != "val":
            return
        self.train_dataset.metadata["needs"] = {need.component: need.needed for need in self.needs}
        CONSOLE.print(Markdown(f"**What this scene needs**\n\n{needs_table(self.needs)}"))
        if self.targets is not None:
            prepared = set(self.targets.names)  # without damaged photos
            names = [photo.name for photo in self.train_dataset.photos if photo.name in prepared]
            self.train_dataset.metadata["feature_statistics"] = self.targets.feature_statistics(names)
            self.train_dataset.metadata["clip_targets"] = partial(self.targets.clip_features, names)
        _log(self._memory_budget())

    @cached_property
    def targets(self) -> TargetReader | None:
        """The prepared targets of all photos, or None where only colours are trained. Made on first use,
        so that the viewer and exports never wait for them."""
        photos = list(self.photos.values())
        if self.config.clip == "none":
            return None
        return prepare_collection(
            photos,
            self._reconstruction(),
            self.config,
            self.cache_dir,
            self.device,
            log=_log,
            regions=self._region_source,
        ).reader

    def clean_store(self) -> tuple[int, int]:
        """Delete what the scene's photos do not use with this configuration; returns files and bytes."""
        c = self.config
        used = {CLIP: c.clip != "none", DENSE: c.dense != "none", FOREGROUND: c.foreground == "text"}
        used[REGIONS] = self._region_source is not None
        names = [photo.name for d in (self.train_dataset, self.eval_dataset) for photo in d.photos]
        return FeatureStore(self.cache_dir).clean([kind for kind, wanted in used.items() if wanted], names)

    @cached_property
    def _region_source(self) -> RegionSource | None:
        c = self.config
        return region_source(c.regions, c.region_level, c.sam, self.data_folder, self.device)

    @cached_property
    def needs(self) -> list[Need]:
        """What of the optional components this scene needs, measured on first use."""
        learns = self.config.clip != "none"
        sources = Sources(
            dense=learns and self.config.dense != "none",
            regions=learns and self._region_source is not None,
        )
        photos, reconstruction = list(self.photos.values()), self._reconstruction()
        return scene_needs(photos, reconstruction, plan_crops(photos, reconstruction, self.config), sources)

    @cached_property
    def photos(self) -> dict[str, Photo]:
        """All photos by name, with their foreground masks, which both datasets then read. Made on first use,
        as the targets are."""
        datasets = (self.train_dataset, self.eval_dataset)
        photos = {photo.name: photo for dataset in datasets for photo in dataset.photos}
        masked = with_foreground(
            list(photos.values()), self.config, self.data_folder, self.cache_dir, self.device, _log
        )
        photos = {photo.name: photo for photo in masked}
        for dataset in datasets:
            dataset.photos[:] = [photos[photo.name] for photo in dataset.photos]
        return photos

    def foreground(self, name: str) -> Bool[Tensor, "h w"] | None:
        """Where a photo counts, at the size that it is trained at; None where all of it does."""
        return self.photos[name].read_mask(self.config.camera_res_scale_factor)

    @property
    def data_folder(self) -> Path:
        """Folder of the scene."""
        data = Path(self.config.dataparser.data)
        return data if data.is_dir() else data.parent

    @property
    def cache_dir(self) -> Path:
        """Folder of prepared targets."""
        return (self.config.cache_dir or self.data_folder / "lang3dxl_cache").expanduser()

    def _reconstruction(self) -> Reconstruction:
        """The model in its own units: COLMAP's, or for other dataparsers one made of the seed points."""
        own = getattr(self.dataparser, "reconstruction", None)
        if own is not None:
            return own
        return reconstruction_of([self.train_dataparser_outputs, self.eval_dataset._dataparser_outputs])

    @cached_property
    def _train_cache(self) -> PhotoCache:
        _ = self.targets  # not to be made in the cache's thread
        return PhotoCache(lambda index: self._read(self.train_dataset, index), self.cache_bytes)

    @property
    def cache_bytes(self) -> float:
        """Memory for photos and targets."""
        gigabytes = self.config.cache_gb
        return machine_memory() / 4 if gigabytes is None else gigabytes * 1e9

    def _memory_budget(self) -> str:
        """What training holds in memory of the photos, estimated from the first one's targets."""
        photos, scale = self.train_dataset.photos, self.config.camera_res_scale_factor
        total = 3.0 * sum(math.prod(scaled_size(p.width, p.height, scale)) for p in photos)
        if self.targets is not None:
            total += len(photos) * self.targets.bytes_of(self.targets.names[0])
        held = min(total, self.cache_bytes)
        return (
            f"memory: at most {held / 1e9:.2f} GB of photos and targets at a time (of "
            f"{total / 1e9:.2f} GB in {len(photos)} photos), {self.config.read_ahead} photos read ahead "
            "(--pipeline.datamanager.cache-gb sets the most)"
        )

    def sample_train_cameras(self) -> list[int]:
        """A new round of all training photos that can be used."""
        rounds = super().sample_train_cameras()
        usable = [i for i in rounds if i not in self._left_out]
        if not usable:
            raise UserError("none of the training photos can be used: see the reasons above")
        return usable

    def next_train(self, step: int) -> tuple[Cameras, dict]:
        """Camera and batch of the next training photo; every photo once before any comes again.

        A photo that turns out to be damaged is left out from then on, with a line in the log.
        """
        index = self.train_unseen_cameras.pop(0)
        if not self.train_unseen_cameras:
            self.train_unseen_cameras = self.sample_train_cameras()
        try:
            with part("data"):
                data = self._train_cache.get(index, self.train_unseen_cameras[: self.config.read_ahead])
                camera, batch = self._batch(self.train_dataset, index, data)
        except UserError as reason:
            _log(f"{self.train_dataset.photos[index].name} is left out of training: {reason}")
            self._left_out.add(index)
            # The round goes on without it: a resumed run, which comes to know it later, has the same order.
            rest = [i for i in self.train_unseen_cameras if i != index]
            self.train_unseen_cameras = rest or self.sample_train_cameras()
            return self.next_train(step)
        camera.metadata = {"cam_idx": index}
        self.photo_in_hand = batch["name"]
        return camera, batch

    def round_state(self) -> dict[str, Any]:
        """Photos that are still to come in this round, and what decides on the next, for a checkpoint."""
        names = [photo.name for photo in self.train_dataset.photos]
        generator = getattr(self, "random_generator", None)  # "fps" sampling has none
        return {
            "upcoming": [names[i] for i in self.train_unseen_cameras],
            "generator": generator and generator.getstate(),
        }

    def restore_round(self, state: dict[str, Any]) -> None:
        """The reverse; photos that this run does not have are skipped, new ones join in the next round."""
        index = {photo.name: i for i, photo in enumerate(self.train_dataset.photos)}
        if state["generator"] is not None and hasattr(self, "random_generator"):
            self.random_generator.setstate(state["generator"])
        upcoming = [index[name] for name in state["upcoming"] if name in index]
        self.train_unseen_cameras = upcoming or self.sample_train_cameras()

    def train_photos(self) -> Iterator[tuple[Cameras, dict]]:
        """Camera and batch of every training photo once, without the damaged ones."""
        for index, photo in enumerate(self.train_dataset.photos):
            if index in self._left_out:
                continue
            try:
                camera, batch = self._batch(self.train_dataset, index, self._read(self.train_dataset, index))
            except UserError as reason:
                CONSOLE.log(f"[yellow]{photo.name} is left out: {reason}")
                continue
            camera.metadata = {"cam_idx": index}
            yield camera, batch

    def next_eval_image(self, step: int) -> tuple[Cameras, dict]:
        """Camera and batch of a held-out photo, in turn."""
        return next(self._eval_rounds)

    @cached_property
    def _eval_rounds(self) -> Iterator[tuple[Cameras, dict]]:
        return chain.from_iterable(repeat(EvalPhotos(self)))

    @property
    def fixed_indices_eval_dataloader(self) -> EvalPhotos:  # type: ignore[override]
        """All held-out photos, read one at a time."""
        return EvalPhotos(self)

    def get_train_rays_per_batch(self) -> int:
        """Pixels of a typical photo, for nerfstudio's speed display."""
        return int((self.train_dataset.cameras.width * self.train_dataset.cameras.height).float().mean())

    def _read(self, dataset: PhotoDataset, index: int) -> dict[str, Any]:
        """Everything a step needs of one photo, as it is kept in memory: bytes and half precision.

        `image` [h, w, 3] uint8, `mask` [h, w, 1] bool if any, and with semantics `clip_target` [Hd, Wd, C],
        `crop_sides` (fractions of the width) and, if any, `dense_target` [t, t, D] and `regions` [h, w]
        (labels, −1 for none).
        """
        data: dict[str, Any] = dict(dataset.read(index))
        if self.targets is not None:
            name = dataset.photos[index].name
            clip = self.targets.clip(name)
            found = {
                "clip_target": clip.features,
                "dense_target": self.targets.dense(name),
                "regions": self.targets.regions(name),
            }
            # Cloned: read from disk now, not when the step comes to it.
            data |= {key: value.clone() for key, value in found.items() if value is not None}
            data["crop_sides"] = clip.crop_fractions
        return data

    def _batch(self, dataset: PhotoDataset, index: int, data: dict[str, Any]) -> tuple[Cameras, dict]:
        """What was read of a photo as a step takes it: on the device, with `name` and `image_idx`."""
        batch: dict[str, Any] = {
            key: value.to(self.device) if isinstance(value, Tensor) else value for key, value in data.items()
        }
        for key, number in (
            ("clip_target", torch.float32),
            ("dense_target", torch.float32),
            ("regions", torch.int64),
        ):
            if key in batch:
                batch[key] = batch[key].to(number)
        batch |= {"image_idx": index, "name": dataset.photos[index].name}
        return dataset.cameras[index : index + 1].to(self.device), batch


class EvalPhotos:
    """Photos to evaluate as (camera, batch) pairs, one photo in memory at a time; damaged ones are left out,
    with a line in the log.

    Args:
        dataset: the held-out photos without it.
        names: of its photos that are wanted; all without it.
    """

    def __init__(
        self,
        datamanager: Lang3DXLDataManager,
        dataset: PhotoDataset | None = None,
        names: Collection[str] | None = None,
    ):
        self._datamanager = datamanager
        self.dataset = dataset or datamanager.eval_dataset
        photos = enumerate(self.dataset.photos)
        self._wanted = [index for index, photo in photos if names is None or photo.name in names]

    def __len__(self) -> int:
        return len(self._wanted)

    def __iter__(self) -> Iterator[tuple[Cameras, dict]]:
        dataset = self.dataset
        _ = self._datamanager.targets  # what goes wrong in preparing them is no single photo's fault
        usable = False
        for index in self._wanted:
            photo = dataset.photos[index]
            try:
                item = self._datamanager._batch(dataset, index, self._datamanager._read(dataset, index))
            except UserError as reason:
                _log(f"{photo.name} is left out of evaluation: {reason}")
                continue
            usable = True
            yield item
        if not usable:
            raise UserError("none of the held-out photos can be used: see the reasons above")


def _log(message: str) -> None:
    """Say it as it is: in a photo's name, brackets are no markup."""
    CONSOLE.log(escape(message))


def pinhole_cameras(photos: list[Photo], posed: Cameras, scale: float) -> Cameras:
    """Cameras of the photos as they are read at `scale`: exact intrinsics for the rounded sizes."""
    sizes = torch.tensor([scaled_size(p.width, p.height, scale) for p in photos])
    full = torch.tensor([[p.width, p.height] for p in photos], dtype=torch.float64)
    zoom = sizes / full
    return Cameras(
        camera_to_worlds=posed.camera_to_worlds,
        fx=(torch.tensor([p.fx for p in photos]) * zoom[:, 0]).float(),
        fy=(torch.tensor([p.fy for p in photos]) * zoom[:, 1]).float(),
        cx=(torch.tensor([p.cx for p in photos]) * zoom[:, 0]).float(),
        cy=(torch.tensor([p.cy for p in photos]) * zoom[:, 1]).float(),
        width=sizes[:, 0],
        height=sizes[:, 1],
    )
