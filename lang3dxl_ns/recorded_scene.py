"""Cameras of a finished run from its own folder, for when the photos are not there any more."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox

from lang3dxl_ns.query.scene_file import SCENE_FILE, SceneFile


@dataclass
class RecordedSceneDataParserConfig(DataParserConfig):
    """The scene that a run has written down."""

    _target: type = field(default_factory=lambda: RecordedSceneDataParser)
    run: Path = Path()
    """Folder of the run."""


class RecordedSceneDataParser(DataParser):
    """Cameras at the size that they were trained at. Nothing is read but the run's own folder."""

    config: RecordedSceneDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        scene = SceneFile.read(self.config.run / SCENE_FILE)
        chosen = [photo for photo in scene.photos if (photo.split == "train") == (split == "train")]
        photos = [photo.photo(Path(scene.data)) for photo in chosen]
        cameras = Cameras(
            camera_to_worlds=torch.tensor([p.camera_to_world for p in chosen]),
            fx=torch.tensor([p.fx for p in chosen]),
            fy=torch.tensor([p.fy for p in chosen]),
            cx=torch.tensor([p.cx for p in chosen]),
            cy=torch.tensor([p.cy for p in chosen]),
            width=torch.tensor([p.width for p in chosen]),
            height=torch.tensor([p.height for p in chosen]),
        )
        return DataparserOutputs(
            image_filenames=[photo.path for photo in photos],
            cameras=cameras,
            scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])),
            metadata={
                "photos": photos,
                # The checkpoint brings its own Gaussians: as few as there can be to begin with.
                "points3D_xyz": torch.eye(4)[:, :3],
                "points3D_rgb": torch.zeros(4, 3),
            },
            dataparser_transform=torch.tensor(scene.transform),
            dataparser_scale=scene.scale,
        )


def recorded_scene(run: Path | None) -> RecordedSceneDataParserConfig | None:
    """The scene of a run's folder, if there is one."""
    if run is None or not (run / SCENE_FILE).is_file():
        return None
    return RecordedSceneDataParserConfig(run=run)
