"""Data manager: training's photos and targets (`TrainingData`) as nerfstudio asks for them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, repeat
from pathlib import Path

import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
)
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing, without
from lang3dxl_ns.plugin.cameras import to_cameras
from lang3dxl_ns.plugin.dataparser import (
    OpenedCaptureConfig,
    PhotoCollectionDataParser,
    PhotoCollectionDataParserConfig,
    parser_for,
)
from lang3dxl_ns.plugin.inert_settings import OF_IMAGE_CACHES
from lang3dxl_ns.plugin.photo_dataset import PhotoDataset
from lang3dxl_ns.preparation.needs import needs_table
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.targets import FACTS, Batch, SceneFacts
from lang3dxl_ns.scene.camera import LONGEST_SIDE
from lang3dxl_ns.scene.capture import recorded_capture, say_held_out
from lang3dxl_ns.scene.capture_settings import CAPTURE_BOUNDS
from lang3dxl_ns.scene.companions import cache_folder
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord
from lang3dxl_ns.training.batches import TrainingData


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


_BOUNDS = {"camera_res_scale_factor": (0.001, 8), "cache_gb": (0, 1e6), "read_ahead": (0, 1000)}
_OF_PARSER = {**CAPTURE_BOUNDS, "scene_scale": (1e-9, 1e9)}


class Lang3DXLDataManager(FullImageDatamanager):
    """Source of one photo per step: camera, image, mask, and the targets of the semantic losses."""

    config: Lang3DXLDataManagerConfig
    data: TrainingData
    """The photos and targets."""
    train_dataset: PhotoDataset
    eval_dataset: PhotoDataset
    dataparser: PhotoCollectionDataParser

    def __init__(self, config: Lang3DXLDataManagerConfig, *args, **kwargs):
        config.check()
        if config.data is not None:
            config.dataparser.data = Path(config.data)
        run = config.run if kwargs.get("test_mode", "val") != "val" else None
        if run is not None and (run / SCENE_FILE).is_file():
            config.dataparser = opened_again(config, SceneRecord.read(run / SCENE_FILE))
        else:
            # Never find a run's own cameras anew: its Gaussians would not match them.
            config.dataparser = parser_for(config.dataparser, config.cache_dir, config.run is None)
        config.data = config.dataparser.data
        super().__init__(config, *args, **kwargs)

    def get_datapath(self) -> Path:
        """Return the folder where the viewer keeps camera paths, which is the run's."""
        return self.config.run or super().get_datapath()

    def create_train_dataset(self) -> PhotoDataset:
        """Open the photos, and build the dataset of training photos, with facts for the model."""
        config, capture = self.config, self.dataparser.capture
        self.data = TrainingData(
            capture, config, cache_folder(capture.folder, config.cache_dir), self.device,
            config.targets_in_steps, config.camera_res_scale_factor, config.cache_gb, config.read_ahead,
            config.train_cameras_sampling_seed,
        )  # fmt: skip
        dataset = self._dataset(self.train_dataparser_outputs, capture.split.train)
        positions = dataset.cameras.camera_to_worlds[..., 3]
        dataset.metadata[FACTS] = SceneFacts(list(capture.split.train), positions)
        return dataset

    def create_eval_dataset(self) -> PhotoDataset:
        """Build the dataset of held-out photos."""
        outputs = self.dataparser.get_dataparser_outputs(split=self.test_split)
        return self._dataset(outputs, self.data.capture.split.held_out)

    def _dataset(self, outputs: DataparserOutputs, names: tuple[str, ...]) -> PhotoDataset:
        known = {photo.name: photo for photo in self.data.as_read}
        outputs.metadata["photos"] = [known[name] for name in names]
        return PhotoDataset(outputs, self.data.scale, self.data.working)

    def setup_train(self) -> None:
        """Prepare missing targets before training; give the model their statistics and the scene's needs."""
        if self.test_mode == "val":
            say_held_out(self.data.capture)
            say(needs_table(self.data.needs))
            self.train_dataset.metadata[FACTS] = self.data.facts()

    def next_train(self, step: int) -> tuple[Cameras, Batch]:  # type: ignore[override]
        """Return camera and batch of the next training photo; every photo appears once per round. A photo
        found to be damaged is left out from then on, and logged."""
        view, batch = self.data.next()
        return to_cameras(view), batch

    def next_eval_image(self, step: int) -> tuple[Cameras, Batch]:  # type: ignore[override]
        """Return camera and batch of a held-out photo, in turn."""
        return next(self._eval_rounds)

    @cached_property
    def _eval_rounds(self) -> Iterator[tuple[Cameras, Batch]]:
        rounds = repeat(self.data.capture.split.held_out)
        return chain.from_iterable(map(self.read, rounds))

    @property
    def fixed_indices_eval_dataloader(self) -> Iterator[tuple[Cameras, Batch]]:  # type: ignore[override]
        """All held-out photos, which are read one at a time. nerfstudio gets this when its viewer starts,
        which must not prepare anything yet."""
        return self.read(self.data.capture.split.held_out)

    def read(self, names: Iterable[str]) -> Iterator[tuple[Cameras, Batch]]:
        """Yield camera and batch, with targets, of photos by name, as `TrainingData.read` does."""
        return ((to_cameras(view), batch) for view, batch in self.data.read(names))

    def get_train_rays_per_batch(self) -> int:
        """Return the pixels of a typical photo, for nerfstudio's speed display."""
        return int((self.train_dataset.cameras.width * self.train_dataset.cameras.height).float().mean())


def opened_again(config: Lang3DXLDataManagerConfig, record: SceneRecord) -> OpenedCaptureConfig:
    """Open a run's photos; if they are gone, or no longer those that it was trained on (nerfstudio would find
    another frame for the cameras, or hold other photos out), its recorded cameras, which is said."""
    try:
        source = parser_for(config.dataparser, config.cache_dir, may_reconstruct=False)
        capture = source.open()
        if not record.has_frame(capture.recorded_frame) or set(record.trained) != set(capture.split.train):
            raise UserError(f"photos or cameras in {capture.folder} are not those of the run's training")
        return OpenedCaptureConfig(data=source.data, capture=capture, scene_scale=source.scene_scale)
    except (UserError, FileNotFoundError) as reason:
        say(f"The run's own cameras are used: {reason}")
        config.camera_res_scale_factor = 1.0
        config.longer_side = LONGEST_SIDE  # the recorded cameras have the size of training
        return OpenedCaptureConfig(data=config.dataparser.data, capture=recorded_capture(record))
