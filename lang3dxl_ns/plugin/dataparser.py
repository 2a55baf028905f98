"""Dataparser of captures, and the choice for --data."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from lang3dxl_ns.common.console import silence_libraries
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.common.settings_help import without
from lang3dxl_ns.plugin.cameras import to_nerfstudio
from lang3dxl_ns.plugin.inert_settings import OF_COLMAP
from lang3dxl_ns.scene.capture import Capture, CaptureSettings, find_source, open_capture, say_left_out
from lang3dxl_ns.scene.frame import Frame


@without(*OF_COLMAP)
@dataclass
class PhotoCollectionDataParserConfig(CaptureSettings, ColmapDataParserConfig):  # type: ignore[misc]
    """Settings of a folder with photos and a COLMAP model or a transforms.json, and optionally masks/."""

    _target: type = field(default_factory=lambda: PhotoCollectionDataParser)
    downscale_factor: int | None = 1
    """Always 1, since photos are resized on reading (--pipeline.datamanager.camera-res-scale-factor)."""

    def open(self) -> Capture:
        """Open the capture, and say which of its photos are left out, and why."""
        if self.downscale_factor != 1:
            raise UserError(
                f"--downscale-factor is {self.downscale_factor}: leave it at 1, resize photos with "
                "--pipeline.datamanager.camera-res-scale-factor"
            )
        capture = open_capture(self.data, self, may_reconstruct=False)
        say_left_out(capture)
        if len(capture.photos) == 1:
            need = "a scene needs at least two, one to learn from and one to hold out"
            raise UserError(f"{self.data} has one usable photo: {need}")
        return capture


@dataclass
class CaptureOutputs(DataparserOutputs):
    """nerfstudio's description of a split, with the frame in float64."""

    frame: Frame | None = None

    @classmethod
    def of(cls, capture: Capture, split: str, side: float) -> CaptureOutputs:
        """Describe a split in a cube from -`side` to `side`, with the points to start from."""
        names = capture.split.train if split == "train" else capture.split.held_out
        known, frame = {photo.name: photo for photo in capture.photos}, capture.recorded_frame
        photos = [known[name] for name in names]
        poses = torch.from_numpy(capture.poses(names))
        seeds = dict(zip(("points3D_xyz", "points3D_rgb"), capture.seeds or (), strict=False))
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

    config: PhotoCollectionDataParserConfig | OpenedCaptureConfig

    @cached_property
    def capture(self) -> Capture:
        """The capture, which is opened once."""
        return self.config.open()

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        return CaptureOutputs.of(self.capture, split, self.config.scene_scale)


@dataclass
class OpenedCaptureConfig(DataParserConfig):
    """Settings of a run's capture, which is open already."""

    _target: type = field(default_factory=lambda: PhotoCollectionDataParser)
    capture: Capture | None = None
    scene_scale: float = 1.0

    def open(self) -> Capture:
        """Return the capture."""
        assert self.capture is not None
        return self.capture


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
