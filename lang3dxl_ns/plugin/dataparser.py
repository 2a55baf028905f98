"""Dataparsers: captures, recorded cameras of a run; the choice for --data."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from torch import Tensor

from lang3dxl_ns.common.console import say, silence_libraries
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.common.settings_help import without
from lang3dxl_ns.plugin.cameras import to_nerfstudio
from lang3dxl_ns.plugin.inert_settings import OF_COLMAP
from lang3dxl_ns.scene.camera import view_matrix
from lang3dxl_ns.scene.capture import Capture, CaptureSettings, Split, find_source, open_capture, say_left_out
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto
from lang3dxl_ns.scene.frame import Frame
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord


@without(*OF_COLMAP)
@dataclass
class PhotoCollectionDataParserConfig(CaptureSettings, ColmapDataParserConfig):  # type: ignore[misc]
    """Settings of a folder with photos and a COLMAP model or a transforms.json, and optionally masks/."""

    _target: type = field(default_factory=lambda: PhotoCollectionDataParser)
    downscale_factor: int | None = 1
    """Always 1, since photos are resized on reading (--pipeline.datamanager.camera-res-scale-factor)."""


@dataclass
class CaptureOutputs(DataparserOutputs):
    """nerfstudio's description of a split, with the frame in float64."""

    frame: Frame | None = None

    @classmethod
    def of(cls, capture: Capture, split: str, side: float, **seeds: Tensor) -> CaptureOutputs:
        """Describe a split in a cube from -`side` to `side`, with the points to start from."""
        names = capture.split.train if split == "train" else capture.split.held_out
        known, frame = {photo.name: photo for photo in capture.photos}, capture.recorded_frame
        photos = [known[name] for name in names]
        poses = torch.from_numpy(capture.poses(names))
        return cls(
            image_filenames=[photo.path for photo in photos],
            cameras=to_nerfstudio([photo.lens for photo in photos], poses),
            scene_box=SceneBox(torch.tensor([[-side] * 3, [side] * 3])),
            metadata={"photos": photos, **seeds},
            dataparser_transform=torch.from_numpy(frame.transform).float(),
            dataparser_scale=frame.scale,
            frame=frame,
        )

    def save_dataparser_transform(self, path: Path) -> None:
        """Write the frame for other programs, as nerfstudio does, but unrounded."""
        assert self.frame is not None
        content = {"transform": self.frame.transform.tolist(), "scale": self.frame.scale}
        write_atomically(path, json.dumps(content, indent=4))


class PhotoCollectionDataParser(DataParser):
    """Dataparser of a capture. Photos are undistorted on reading (`Photo.read`), so all output cameras are
    pinholes."""

    config: PhotoCollectionDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        capture = self.capture
        if split == "train" and (held_out := len(capture.photos) - len(capture.split.train)):
            say(
                f"{held_out} of {len(capture.photos)} photos are held out of training, for evaluation "
                "(`lang3dxl-colmap --eval-mode all` after all other options trains on all)"
            )
        points, colors = map(torch.from_numpy, capture.seeds)
        # Without points in a transforms.json, which is allowed, training starts from random ones.
        seeds = {"points3D_xyz": points, "points3D_rgb": colors}
        seeds = seeds if capture.transforms is None or len(points) else {}
        return CaptureOutputs.of(capture, split, self.config.scene_scale, **seeds)

    @cached_property
    def capture(self) -> Capture:
        """The capture. Which of its photos are left out, and why, is said once."""
        if self.config.downscale_factor != 1:
            raise UserError(
                f"--downscale-factor is {self.config.downscale_factor}: leave it at 1, resize photos with "
                "--pipeline.datamanager.camera-res-scale-factor"
            )
        capture = open_capture(self.config.data, self.config, may_reconstruct=False)
        say_left_out(capture)
        if len(capture.photos) == 1:
            need = "a scene needs at least two, one to learn from and one to hold out"
            raise UserError(f"{self.config.data} has one usable photo: {need}")
        return capture


# ── a run whose photos are gone ───────────────────────────────────────────────────────────────────────────


@dataclass
class RecordedSceneDataParserConfig(DataParserConfig):
    """Settings of the scene recorded in a run's folder."""

    _target: type = field(default_factory=lambda: RecordedSceneDataParser)
    run: Path = Path()
    """Folder of the run."""


class RecordedSceneDataParser(DataParser):
    """Dataparser of recorded cameras at training resolution, which reads nothing outside the run's folder."""

    config: RecordedSceneDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        # The checkpoint brings its own Gaussians, so start with as few as possible.
        few, colors = torch.eye(4)[:, :3], torch.zeros(4, 3)
        return CaptureOutputs.of(self.capture, split, 1.0, points3D_xyz=few, points3D_rgb=colors)

    @cached_property
    def capture(self) -> Capture:
        """The recorded photos and cameras, without points."""
        scene = SceneRecord.read(self.config.run / SCENE_FILE)
        frame, nothing = Frame(np.array(scene.transform, np.float64), scene.scale), np.zeros((0, 3))
        world = frame.inverse().poses(np.array([photo.camera_to_world for photo in scene.photos]))
        views = [view_matrix(pose)[:3].numpy() for pose in torch.from_numpy(world)]
        photos = [photo.photo(Path(scene.data)) for photo in scene.photos]
        tracked = {
            photo.name: TrackedPhoto(photo.name, photo.lens, view, nothing, nothing[:, :2])
            for photo, view in zip(photos, views, strict=True)
        }
        model = Reconstruction(tracked, nothing, nothing.astype(np.uint8))
        train, held_out = (
            tuple(photo.name for photo in scene.photos if photo.split == part) for part in ("train", "eval")
        )
        split = Split(train, held_out or train)  # with --eval-mode all, no photo is held out
        return Capture(Path(scene.data), photos, model, known_split=split, known_frame=frame)


def recorded_scene(run: Path | None) -> RecordedSceneDataParserConfig | None:
    """Return the settings for the scene recorded in a run's folder; None if there is none."""
    if run is None or not (run / SCENE_FILE).is_file():
        return None
    return RecordedSceneDataParserConfig(run=run)


# ── the choice for --data ─────────────────────────────────────────────────────────────────────────────────


def parser_for(
    config: DataParserConfig, cache_dir: Path | None, may_reconstruct: bool
) -> PhotoCollectionDataParserConfig:
    """Choose the dataparser for `config.data`, and note in it which model it found, so that a resumed run
    finds the same. Photos without a model are reconstructed, if allowed; a video becomes a folder of frames.
    Raises UserError if the photos don't make a scene, and for nerfstudio's own dataparsers."""
    if not isinstance(config, PhotoCollectionDataParserConfig):
        raise UserError(
            f"{type(config).__name__} is not read here: leave the dataparser's name off, so that the COLMAP "
            "model or transforms.json of the folder is found, or make one with ns-process-data"
        )
    folder, source = find_source(config.data, config, cache_dir, may_reconstruct)
    if source.suffix == ".json":
        config.data = source
    else:
        config.data = folder
        if config.colmap_path is None:
            config.colmap_path = source.relative_to(folder) if source.is_relative_to(folder) else source
    return config


silence_libraries()  # nerfstudio imports this module before the libraries that warn

photo_collection = DataParserSpecification(
    config=PhotoCollectionDataParserConfig(),
    description="A folder of photos with a COLMAP model or a transforms.json, optionally masks/.",
)
