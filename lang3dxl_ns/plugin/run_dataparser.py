"""Dataparser for the cameras stored in a finished run, for when its photos are gone."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox

from lang3dxl_ns.plugin.cameras import to_nerfstudio
from lang3dxl_ns.query.run_file import SCENE_FILE, SceneFile


@dataclass
class RecordedSceneDataParserConfig(DataParserConfig):
    """The scene recorded in a run's folder."""

    _target: type = field(default_factory=lambda: RecordedSceneDataParser)
    run: Path = Path()
    """Folder of the run."""


class RecordedSceneDataParser(DataParser):
    """Cameras at training resolution. Reads nothing outside the run's folder."""

    config: RecordedSceneDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        scene = SceneFile.read(self.config.run / SCENE_FILE)
        chosen = [photo for photo in scene.photos if (photo.split == "train") == (split == "train")]
        photos = [photo.photo(Path(scene.data)) for photo in chosen]
        poses = torch.tensor([photo.camera_to_world for photo in chosen], dtype=torch.float32)
        cameras = to_nerfstudio([photo.lens for photo in photos], poses)
        return DataparserOutputs(
            image_filenames=[photo.path for photo in photos],
            cameras=cameras,
            scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])),
            metadata={
                "photos": photos,
                # The checkpoint brings its own Gaussians: start with the fewest possible.
                "points3D_xyz": torch.eye(4)[:, :3],
                "points3D_rgb": torch.zeros(4, 3),
            },
            dataparser_transform=torch.tensor(scene.transform, dtype=torch.float32),
            dataparser_scale=scene.scale,
        )


def recorded_scene(run: Path | None) -> RecordedSceneDataParserConfig | None:
    """The recorded scene of a run's folder, if there is one."""
    if run is None or not (run / SCENE_FILE).is_file():
        return None
    return RecordedSceneDataParserConfig(run=run)
