"""Data manager: one photo per step with its targets, read ahead through a bounded cache."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import chain, repeat
from pathlib import Path
from typing import Any, Literal

import tyro
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
)
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markdown import Markdown
from rich.markup import escape
from torch import Tensor

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.common.reports import part
from lang3dxl_ns.common.settings_help import showing, without
from lang3dxl_ns.plugin.dataparser import (
    PhotoCollectionDataParser,
    PhotoCollectionDataParserConfig,
    parser_for,
    recorded_scene,
)
from lang3dxl_ns.plugin.inert_settings import OF_IMAGE_CACHES
from lang3dxl_ns.plugin.nerfstudio_scenes import photos_of, reconstruction_of
from lang3dxl_ns.plugin.photo_dataset import EvalPhotos, PhotoDataset
from lang3dxl_ns.preparation.foreground import foreground_kind, with_foreground
from lang3dxl_ns.preparation.model_files import CLIP_OPTION, find_model
from lang3dxl_ns.preparation.needs import Need, needs_table, scene_needs
from lang3dxl_ns.preparation.photo_cache import PhotoCache, has_vanished
from lang3dxl_ns.preparation.physical_scale import CropPlan, plan_crops
from lang3dxl_ns.preparation.prepare import prepare
from lang3dxl_ns.preparation.regions import RegionSource, region_source
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore, PhotosGoneError
from lang3dxl_ns.preparation.targets import CLIP, DENSE, FINE, REGIONS, Batch, SceneFacts, TargetReader
from lang3dxl_ns.preparation.working_photos import PHOTO_MASKS, PHOTOS, WorkingPhotos
from lang3dxl_ns.scene.camera import LONGEST_SIDE
from lang3dxl_ns.scene.colmap import Reconstruction
from lang3dxl_ns.scene.frame import Frame
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.reconstruction import doubtful_photos
from lang3dxl_ns.scene.record import SCENE_FILE, ScenePhoto, SceneRecord
from lang3dxl_ns.training.batches import MOST_GONE, read_targets, settle, to_batch


@without(*OF_IMAGE_CACHES)
@showing(
    *("dataparser", "clip", "clip_features", "dense", "quality", "longer_side", "camera_res_scale_factor"),
    *("scale_range", "scale_preset", "scale_mode", "workers", "engine", "address", "foreground"),
    *("foreground_prompts", "foreground_model", "skip_damaged_masks", "regions", "region_prompts", "sam"),
    *("cache_dir", "cache_gb"),
)
@dataclass
class Lang3DXLDataManagerConfig(PreparationConfig, FullImageDatamanagerConfig):
    """Settings of photos and their targets. `--pipeline.datamanager.clip none` trains only colors."""

    _target: type = field(default_factory=lambda: Lang3DXLDataManager)
    dataparser: AnnotatedDataParserUnion = field(default_factory=PhotoCollectionDataParserConfig)
    """Source of photos and cameras."""
    cache_dir: Path | None = None
    """Folder of prepared targets (default: lang3dxl_cache inside the data folder)."""
    cache_gb: float | None = None
    """Memory in gigabytes for decoded photos and their targets. The first photos that fit are kept, and the
    others are read ahead of their use. Default: a quarter of the machine's memory."""
    read_ahead: int = 16
    """Number of photos read ahead of the training step, in addition to that memory."""
    targets_in_steps: tyro.conf.Suppress[bool] = True
    """Whether training steps learn from the targets; set together with the encoders."""
    run: tyro.conf.Suppress[Path | None] = None
    """Folder of the run whose config.yml these settings come from; set when that file is read."""

    def check(self) -> None:
        """Raise UserError if an option is invalid, before any work."""
        super().check()
        check_numbers(self, _BOUNDS, "--pipeline.datamanager.")
        check_numbers(self.dataparser, {n: b for n, b in _OF_PARSER.items() if hasattr(self.dataparser, n)})

    def settle_targets(self, learned: bool, gathered: bool) -> None:
        """Resolve what is prepared as `batches.settle`, and whether steps read targets."""
        self.targets_in_steps = learned
        settle(self, learned, gathered)


_BOUNDS = {"camera_res_scale_factor": (0.001, 8), "cache_gb": (0, 1e6), "read_ahead": (0, 1000)}
_OF_PARSER = {"scale_factor": (1e-9, 1e9), "scene_scale": (1e-9, 1e9), "train_split_fraction": (0, 1)}


class Lang3DXLDataManager(FullImageDatamanager):
    """Source of one photo per step: camera, image, mask, and the targets of the semantic losses."""

    config: Lang3DXLDataManagerConfig
    train_dataset: PhotoDataset
    eval_dataset: PhotoDataset
    photo_in_hand: str
    """Name of the latest training photo."""

    def __init__(self, config: Lang3DXLDataManagerConfig, *args, **kwargs):
        config.check()
        self._left_out: set[int] = set()
        self._gone = 0
        if config.data is not None:
            config.dataparser.data = Path(config.data)
        opens = kwargs.get("test_mode", "val") != "val"
        recorded = recorded_scene(config.run) if opens else None
        try:
            # never find a run's own cameras anew: its Gaussians would not match them
            config.dataparser = parser_for(config.dataparser, config.cache_dir, config.run is None)
            if isinstance(config.dataparser, PhotoCollectionDataParserConfig):
                config.data = config.dataparser.data
            elif hasattr(config.dataparser, "load_3D_points"):
                config.dataparser.load_3D_points = True  # off by default in some of nerfstudio's
            super().__init__(config, *args, **kwargs)
            if recorded is not None:
                self._check_recorded(SceneRecord.read(recorded.run / SCENE_FILE))
        except (UserError, FileNotFoundError) as reason:
            if recorded is None:
                raise
            _log(f"The run's own cameras are used: {reason}")
            config.dataparser, config.camera_res_scale_factor = recorded, 1.0
            config.longer_side = LONGEST_SIDE  # the recorded cameras have the size of training
            super().__init__(config, *args, **kwargs)

    def _check_recorded(self, scene: SceneRecord) -> None:
        """Raise UserError if the photos are no longer those that the run was trained on: nerfstudio would
        find another frame for the cameras, or hold other photos out."""
        names = [photo.name for photo in self.train_dataset.photos]
        trained = [photo.name for photo in scene.photos if photo.split == "train"]
        known = scene.has_frame(self.frame.transform, self.frame.scale)
        if not known or set(names) != set(trained):
            raise UserError(f"photos or cameras in {self.data_folder} are not those of the run's training")

    def get_datapath(self) -> Path:
        """Return the folder where the viewer keeps camera paths, which is the run's."""
        return self.config.run or super().get_datapath()

    def create_train_dataset(self) -> PhotoDataset:
        dataset = self.dataset_of(self.train_dataparser_outputs)
        positions = dataset.cameras.camera_to_worlds[..., 3]
        SceneFacts([photo.name for photo in dataset.photos], positions).into(dataset.metadata)
        return dataset

    def create_eval_dataset(self) -> PhotoDataset:
        return self.dataset_of(self.dataparser.get_dataparser_outputs(split=self.test_split))

    def dataset_of(self, outputs: DataparserOutputs) -> PhotoDataset:
        """Build the dataset of a dataparser's outputs. Raises UserError if they have no photo."""
        if "photos" not in outputs.metadata:  # one of nerfstudio's own dataparsers
            outputs.metadata["photos"] = photos_of(outputs, Path(self.config.dataparser.data))
        if not outputs.metadata["photos"]:
            raise UserError(
                f"a split of {self.config.dataparser.data} has no photo: add photos (a tenth is held out)"
            )
        photos, side = outputs.metadata["photos"], self.config.longer_side
        if large := sum(max(photo.width, photo.height) > side for photo in photos):
            _log(
                f"{large} of {len(photos)} photos are larger than {side:,} pixels and used at that size "
                "(--pipeline.datamanager.longer-side)"
            )
        outputs.metadata["photos"] = [photo.at_most(side) for photo in photos]
        working = WorkingPhotos(FeatureStore(self.cache_dir))
        return PhotoDataset(outputs, self.config.camera_res_scale_factor, working)

    def setup_train(self) -> None:
        """Prepare missing targets before training; give the model their statistics and the scene's needs."""
        if self.test_mode != "val":
            return
        facts = SceneFacts.of(self.train_dataset.metadata)
        facts.needs = {need.component: need.needed for need in self.needs}
        CONSOLE.print(Markdown(f"**What this scene needs**\n\n{needs_table(self.needs)}"))
        if self.targets is not None:
            prepared = set(self.targets.names)  # damaged photos are missing from it
            names = [photo.name for photo in self.train_dataset.photos if photo.name in prepared]
            if not names:
                raise UserError("none of the training photos can be used: see the reasons above")
            facts.statistics = self.targets.feature_statistics(names, self.config.targets_in_steps)
            facts.clip_targets = partial(self.targets.clip_features, names)
            if self.targets.dense_dim:
                facts.dense_targets = partial(self.targets.dense_features, names)

    @cached_property
    def targets(self) -> TargetReader | None:
        """Prepared targets of all photos; None if only colors are trained. They are made on first use, so
        that the viewer and exports never wait for them."""
        photos = list(self.photos.values())
        if self.config.clip == "none":
            return None
        # Held-out photos have the whole pyramid, which serves as the 2-D teacher.
        fine = [p.name for p in self.train_dataset.photos] if self.config.crops == "fine" else []
        plan, store = self.crop_plan, FeatureStore(self.cache_dir)
        for reason in plan.reasons:
            _log(reason)
        return prepare(
            photos, plan.pixel_sizes, self.config, plan.scales, store, self.device, self._region_source, fine
        )

    def clean_store(self) -> tuple[int, int]:
        """Delete targets that this configuration and the scene's photos don't use; count files and bytes."""
        c, used = self.config, [PHOTOS, PHOTO_MASKS]
        used += [CLIP, FINE] if c.clip != "none" else []
        used += [DENSE] if c.dense != "none" else []
        used += [foreground_kind(c)] if c.foreground == "text" else []
        used += [REGIONS] if self._region_source is not None else []
        names = [photo.name for d in (self.train_dataset, self.eval_dataset) for photo in d.photos]
        shared = self.config.cache_dir is not None
        return FeatureStore(self.cache_dir).clean(used, names, shared)

    @cached_property
    def crop_plan(self) -> CropPlan:
        """Crop sizes of the scene's photos."""
        return plan_crops(list(self.photos.values()), self.reconstruction, self.config)

    @cached_property
    def _region_source(self) -> RegionSource | None:
        return region_source(self.config, self.data_folder)

    @cached_property
    def needs(self) -> list[Need]:
        """Needs of the scene for optional components, measured on first use."""
        learns, photos = self.config.clip != "none", list(self.photos.values())
        dense, regions = self.config.makes_dense, self._region_source is not None
        return scene_needs(photos, self.reconstruction, self.crop_plan, learns and dense, learns and regions)

    @cached_property
    def photos(self) -> dict[str, Photo]:
        """All photos by name, with their foreground masks, which both datasets then use. They are made on
        first use, like the targets."""
        datasets = (self.train_dataset, self.eval_dataset)
        photos = {photo.name: photo for dataset in datasets for photo in dataset.photos}
        masked = with_foreground(
            list(photos.values()), self.config, self.data_folder, self.cache_dir, self.device, _log
        )
        photos = {photo.name: photo for photo in masked}
        for dataset in datasets:
            dataset.photos[:] = [photos[photo.name] for photo in dataset.photos]
        return photos

    def scene_file(self, poses: Float[Tensor, "n 3 4"] | None = None) -> SceneRecord:
        """Describe the scene for the run's folder: photos, cameras and CLIP. `poses`: those of the training
        photos (default: unrefined)."""
        clip, frame = self.config.clip, self.frame
        known = None if clip == "none" else find_model(clip, CLIP_OPTION)
        trained = self._described(self.train_dataset, "train", poses)
        names = {photo.name for photo in trained}  # with --eval-mode all, the same photos are also held out
        held_out = self._described(self.eval_dataset, "eval")
        return SceneRecord(
            photos=[*trained, *(photo for photo in held_out if photo.name not in names)],
            clip=None if known is None else known.address,
            clip_identity=None if known is None else known.clip_identity,
            scale=frame.scale,
            transform=frame.transform.tolist(),
            data=str(expanded(self.data_folder).absolute()),
        ).located(self.photos.values())

    def _described(
        self, dataset: PhotoDataset, split: Literal["train", "eval"], poses: Tensor | None = None
    ) -> list[ScenePhoto]:
        poses, photos = dataset.cameras.camera_to_worlds if poses is None else poses, self.photos
        named = zip((photo.name for photo in dataset.photos), poses.tolist(), strict=True)
        doubts = doubtful_photos(self.cache_dir)
        return [
            ScenePhoto.of(photos[name], split, pose, dataset.scale, doubts.get(name)) for name, pose in named
        ]

    @property
    def data_folder(self) -> Path:
        """Folder of the scene."""
        data = Path(self.config.dataparser.data)
        return data if data.is_dir() else data.parent

    @property
    def frame(self) -> Frame:
        """Similarity from the original coordinates to training's."""
        outputs = self.train_dataparser_outputs
        known = getattr(outputs, "frame", None)
        transform = outputs.dataparser_transform.double().numpy()
        return known if known is not None else Frame(transform, float(outputs.dataparser_scale))

    @property
    def cache_dir(self) -> Path:
        """Folder of prepared targets."""
        return expanded(self.config.cache_dir or self.data_folder / "lang3dxl_cache")

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """The model in its own units: COLMAP's, or else one made from the dataparser's seed points."""
        if isinstance(self.dataparser, PhotoCollectionDataParser):
            return self.dataparser.capture.reconstruction
        return reconstruction_of([self.train_dataparser_outputs, self.eval_dataset._dataparser_outputs])

    @cached_property
    def _train_cache(self) -> PhotoCache:
        _ = self.targets  # prepare the targets now, not in the cache's thread
        read = partial(self._read, self.train_dataset, with_targets=self.config.targets_in_steps)
        gigabytes = self.config.cache_gb
        return PhotoCache(read, machine_memory() / 4 if gigabytes is None else gigabytes * 1e9)

    def sample_train_cameras(self) -> list[int]:
        """Start a new round of all usable training photos."""
        rounds = super().sample_train_cameras()
        usable = [i for i in rounds if i not in self._left_out]
        if not usable:
            raise UserError("none of the training photos can be used: see the reasons above")
        return usable

    def next_train(self, step: int) -> tuple[Cameras, Batch]:  # type: ignore[override]
        """Return camera and batch of the next training photo; every photo appears once per round. A photo
        found to be damaged is left out from then on, and logged."""
        while True:
            index = self.train_unseen_cameras.pop(0)
            if not self.train_unseen_cameras:
                self.train_unseen_cameras = self.sample_train_cameras()
            try:
                with part("data"):
                    data = self._train_cache.get(index, self.train_unseen_cameras[: self.config.read_ahead])
                    camera, batch = self._batch(self.train_dataset, index, data)
            except PhotosGoneError:
                raise
            except UserError as reason:
                _log(f"{self.train_dataset.photos[index].name} is left out of training: {reason}")
                self._leave_out(index, reason)
                # The round continues without the photo, so that a resumed run, which meets it later, has the
                # same order.
                rest = [i for i in self.train_unseen_cameras if i != index]
                self.train_unseen_cameras = rest or self.sample_train_cameras()
                continue
            self.photo_in_hand = batch["name"]
            return camera, batch

    def _leave_out(self, index: int, reason: UserError) -> None:
        """Leave out a photo from now on. Raises PhotosGoneError if too many have vanished."""
        self._left_out.add(index)
        self._gone += has_vanished(reason)
        if self._gone > max(MOST_GONE * len(self.train_dataset), 1):
            raise PhotosGoneError(
                f"{self._gone} of {len(self.train_dataset)} training photos or their targets have vanished; "
                f"the latest reason: {reason}; restore the disk or network share"
            ) from reason

    def round_state(self) -> dict[str, Any]:
        """Return the photos left in this round, and the state that determines the next, for a checkpoint."""
        photos, generator = self.train_dataset.photos, getattr(self, "random_generator", None)
        return {
            "upcoming": [photos[i].name for i in self.train_unseen_cameras],
            "generator": generator and generator.getstate(),  # "fps" sampling has none
        }

    def restore_round(self, state: dict[str, Any]) -> None:
        """Restore `round_state`. Photos that this run lacks are skipped; new ones join in the next round."""
        index = {photo.name: i for i, photo in enumerate(self.train_dataset.photos)}
        if state["generator"] is not None and hasattr(self, "random_generator"):
            self.random_generator.setstate(state["generator"])
        upcoming = [index[name] for name in state["upcoming"] if name in index]
        self.train_unseen_cameras = upcoming or self.sample_train_cameras()

    def train_photos(self) -> Iterator[tuple[Cameras, Batch]]:
        """Yield camera and batch of every training photo once, without the damaged ones."""
        photos = enumerate(self.train_dataset.photos)
        usable = {photo.name for index, photo in photos if index not in self._left_out}
        yield from self.evaluated(self.train_dataset, usable)

    def next_eval_image(self, step: int) -> tuple[Cameras, Batch]:  # type: ignore[override]
        """Return camera and batch of a held-out photo, in turn."""
        return next(self._eval_rounds)

    @cached_property
    def _eval_rounds(self) -> Iterator[tuple[Cameras, Batch]]:
        return chain.from_iterable(repeat(self.evaluated()))

    @property
    def fixed_indices_eval_dataloader(self) -> EvalPhotos:  # type: ignore[override]
        """All held-out photos, which are read one at a time. nerfstudio gets this when its viewer starts,
        which must not prepare anything yet."""
        return self.evaluated()

    def evaluated(
        self, dataset: PhotoDataset | None = None, names: Collection[str] | None = None
    ) -> EvalPhotos:
        """Return the photos of a dataset (default: the held-out ones) with these names (default: all)."""
        dataset = dataset or self.eval_dataset

        def ready() -> Callable[[int], tuple[Cameras, Batch]]:
            _ = self.targets  # errors in preparing targets must not be blamed on a photo
            return partial(self.read, dataset)

        return EvalPhotos(dataset, ready, names)

    def read(self, dataset: PhotoDataset, index: int) -> tuple[Cameras, Batch]:
        """Read camera and batch of a photo. Raises UserError if it can't be read."""
        return self._batch(dataset, index, self._read(dataset, index))

    def get_train_rays_per_batch(self) -> int:
        """Return the pixels of a typical photo, for nerfstudio's speed display."""
        return int((self.train_dataset.cameras.width * self.train_dataset.cameras.height).float().mean())

    def _read(self, dataset: PhotoDataset, index: int, with_targets: bool = True) -> dict[str, Any]:
        """Read a photo's data for a step; see `batches.read_data`."""
        data: dict[str, Any] = dict(dataset.read(index))
        if self.targets is not None and with_targets:
            data |= read_targets(dataset.photos[index].name, self.targets)
        return data

    def _batch(self, dataset: PhotoDataset, index: int, data: dict[str, Any]) -> tuple[Cameras, Batch]:
        """Put a photo's data for a step on the device, with `name` and `image_idx`. The camera stays on the
        CPU, since the host reads its size and would wait for a GPU."""
        batch = to_batch(data, dataset.photos[index].name, index, self.device)
        camera = dataset.cameras[index : index + 1]
        if dataset is self.train_dataset:  # whose cameras may be refined
            camera.metadata = {"cam_idx": index}
        return camera, batch


def _log(message: str) -> None:
    """Log verbatim, since brackets in a photo's name are not markup."""
    CONSOLE.log(escape(message))
