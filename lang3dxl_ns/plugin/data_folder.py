"""Choice of dataparser for `--data`: a COLMAP scene, photos alone, a video, or a transforms.json."""

from __future__ import annotations

from pathlib import Path

from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils.rich_utils import CONSOLE

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.preparation.photo_collection import MODEL_FOLDERS, OWN_MODEL, TRANSFORMS
from lang3dxl_ns.scene.photo_folder import find_photos
from lang3dxl_ns.scene.reconstruct import reconstruct_scene
from lang3dxl_ns.scene.video import extract_frames, frames_folder, is_video


def check_data(data: Path | None) -> None:
    """Raises UserError for a place that does not exist, before encoders are looked for. None passes."""
    place = None if data is None else expanded(data)
    if place is not None and not place.exists() and not frames_folder(place).is_dir():
        raise UserError(f"{data} is not a folder: pass the one that holds your photos as --data, or a video")


def parser_for(
    parser: PhotoCollectionDataParserConfig, cache_dir: Path | None, may_reconstruct: bool
) -> DataParserConfig:
    """The dataparser for `parser.data`: photos without a model are reconstructed, if allowed; a video
    becomes a folder of frames; a folder with only a transforms.json gets nerfstudio's own parser.

    Raises UserError if the photos don't make a scene.
    """
    data = expanded(parser.data).absolute()
    if is_video(data) or (not data.exists() and frames_folder(data).is_dir()):
        data = parser.data = extract_frames(data) if may_reconstruct else frames_folder(data)
    named = parser.colmap_path
    folders: tuple[Path, ...] = (named, *MODEL_FOLDERS, OWN_MODEL)
    if cache_dir is not None:
        folders = (*folders, expanded(cache_dir).absolute() / "reconstruction/sparse/0")
    known = next((f for f in folders if any((data / f).glob("images.*"))), None)
    if known is not None:
        parser.colmap_path = known
    elif (data / TRANSFORMS).is_file():
        CONSOLE.log(f"{data} has a {TRANSFORMS} and no COLMAP model: read as nerfstudio-data")
        return NerfstudioDataParserConfig(data=data)
    elif (
        may_reconstruct and named == type(parser)().colmap_path and data.is_dir() and find_photos(data).names
    ):
        data, model = reconstruct_scene(data, cache_dir)
        parser.colmap_path = model.relative_to(data) if model.is_relative_to(data) else model
    elif may_reconstruct and data.is_dir() and not any(data.iterdir()):
        raise UserError(f"{data} is empty: give the folder with your photos")
    return parser
