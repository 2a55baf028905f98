"""Description of a scene from its data manager: photos, cameras, the CLIP."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from lang3dxl_ns.plugin.datamanager import Lang3DXLDataManager
from lang3dxl_ns.preparation.model_files import CLIP_OPTION, find_model
from lang3dxl_ns.query.run_file import SceneFile, ScenePhoto


def describe_scene(datamanager: Lang3DXLDataManager) -> SceneFile:
    """The scene description kept in a run's folder."""
    outputs, clip = datamanager.train_dataparser_outputs, datamanager.config.clip
    known = None if clip == "none" else find_model(clip, CLIP_OPTION)
    local, trained = Path(clip).expanduser(), _photos(datamanager, "train")
    names = {photo.name for photo in trained}  # with --eval-mode all, the same photos are held out
    return SceneFile(
        photos=[*trained, *(photo for photo in _photos(datamanager, "eval") if photo.name not in names)],
        clip=None if known is None else str(local.absolute()) if local.is_dir() else clip,
        clip_identity=None if known is None else known.identity,
        scale=float(outputs.dataparser_scale),
        transform=outputs.dataparser_transform.tolist(),
        data=str(Path(datamanager.config.dataparser.data).expanduser().absolute()),
    )


def _photos(datamanager: Lang3DXLDataManager, split: Literal["train", "eval"]) -> list[ScenePhoto]:
    masked = datamanager.photos
    dataset = datamanager.train_dataset if split == "train" else datamanager.eval_dataset
    cameras, photos = dataset.cameras, [masked[photo.name] for photo in dataset.photos]
    return [
        ScenePhoto(
            name=photo.name,
            split=split,
            camera_to_world=cameras.camera_to_worlds[i].tolist(),
            lens=photo.lens.scaled(dataset.scale),
            mask=None if photo.mask_path is None else str(photo.mask_path.absolute()),
            size=(photo.lens.width, photo.lens.height),
        )
        for i, photo in enumerate(photos)
    ]
