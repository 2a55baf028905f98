"""Dataparsers: photo collections with a COLMAP model, recorded cameras of a run; the choice for --data."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from lang3dxl_ns.common.console import silence_libraries, some
from lang3dxl_ns.common.errors import UserError, printable
from lang3dxl_ns.common.files import expanded, read_names
from lang3dxl_ns.common.settings_help import without
from lang3dxl_ns.plugin.cameras import to_nerfstudio
from lang3dxl_ns.plugin.inert_settings import OF_COLMAP
from lang3dxl_ns.preparation.foreground import find_mask
from lang3dxl_ns.preparation.photo_collection import (
    MODEL_FOLDERS,
    OWN_MODEL,
    TRANSFORMS,
    find_colmap_model,
    images_path,
    usable_photos,
)
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto, photos_in_model, read_reconstruction
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.photo_folder import extract_frames, find_photos, frames_folder, is_video, photos_below
from lang3dxl_ns.scene.reconstruct import reconstruct_scene, shows_these
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord


@without(*OF_COLMAP)
@dataclass
class PhotoCollectionDataParserConfig(ColmapDataParserConfig):
    """Settings of a folder with images/, a COLMAP model, and optionally masks/."""

    _target: type = field(default_factory=lambda: PhotoCollectionDataParser)
    colmap_path: Path = Path("sparse/0")
    """COLMAP model, relative to the data folder; sparse, colmap/sparse/0 and dense/sparse are tried too."""
    images_path: Path = Path("images")
    """Folder of the photos, relative to the data folder; dense/images is tried too."""
    masks_path: Path | None = Path("masks")
    """Folder of foreground masks, named like the photos (.png or .jpg); white marks what to keep. A photo
    without a mask is used whole. --pipeline.datamanager.foreground has other sources."""
    held_out: Path | None = None
    """Text file with names of the photos to hold out of training, one per line, with or without suffix, in
    place of every eighth photo. `lang3dxl evaluate split` makes one from ground truth."""
    follow_links: bool = False
    """Whether photos and masks may be symbolic links that leave their folder."""
    downscale_factor: int | None = 1
    """Always 1, since photos are resized on reading (--pipeline.datamanager.camera-res-scale-factor)."""


@dataclass
class PhotoCollectionDataParser(ColmapDataParser):
    """Dataparser of any COLMAP model, with lens and size per photo. Photos are undistorted on reading
    (`Photo.read`), so all output cameras are pinholes."""

    config: PhotoCollectionDataParserConfig

    def __init__(self, config: PhotoCollectionDataParserConfig):
        super().__init__(config)
        self.photos: dict[Path, Photo] = {}
        self._left_out: dict[str, UserError] = {}

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        data = self.config.data = expanded(self.config.data).absolute()
        if self.config.downscale_factor != 1:  # nerfstudio would hand the photos' names to a shell
            raise UserError(
                f"--downscale-factor is {self.config.downscale_factor}: leave it at 1, resize photos with "
                "--pipeline.datamanager.camera-res-scale-factor"
            )
        if not data.is_dir():
            raise UserError(f"{data} is not a folder: pass the one that holds images/ and sparse/0 as --data")
        named = self.config.colmap_path
        if named == type(self.config)().colmap_path:  # none was named
            self.config.colmap_path = find_colmap_model(data) or named
        self.config.images_path = images_path(data, self.config.images_path)
        _ = self.reconstruction  # read before the parent looks for anything
        # The parent would require a mask for every photo; here masks are optional and found per photo.
        masks, scaled = self.config.masks_path, self.config.auto_scale_poses
        self.config.masks_path, self.config.auto_scale_poses = None, scaled and self._cameras_are_apart
        try:
            outputs = super()._generate_dataparser_outputs(split, **kwargs)
        finally:
            self.config.masks_path, self.config.auto_scale_poses = masks, scaled
        outputs.metadata["photos"] = [self.photos[path] for path in outputs.image_filenames]
        if split == "train" and (held_out := len(self.photos) - len(outputs.image_filenames)):
            CONSOLE.log(
                f"{held_out} of {len(self.photos)} photos are held out of training, for evaluation "
                "(`lang3dxl-colmap --eval-mode all` after all other options trains on all)"
            )
        # From here on the transform again applies to the model's own coordinates.
        transform = outputs.dataparser_transform.double()
        transform[:, 3] -= transform[:, :3] @ torch.from_numpy(self._origin)
        outputs.dataparser_transform = transform.float()
        return outputs

    def _get_image_indices(self, image_filenames, split):
        if self.config.held_out is None:
            indices = super()._get_image_indices(image_filenames, split)
        else:
            names = [Path(p).relative_to(self._images_folder).as_posix() for p in image_filenames]
            held_out = np.isin(np.arange(len(names)), self._held_out(names))
            indices = np.flatnonzero(held_out != (split == "train"))
        if len(indices) == 0:
            raise UserError(
                f"the {split} split of {self.config.data} has no photo (of {len(image_filenames)} in all): "
                f"add photos, or choose another split with `lang3dxl-colmap --eval-mode …` after all options"
            )
        return indices

    def _held_out(self, photos: list[str]) -> list[int]:
        """Return the indices of the listed photos. Raises UserError if one of them doesn't exist."""
        assert self.config.held_out is not None
        indices, paths = [], map(PurePosixPath, photos)
        forms = [{str(path), str(path.with_suffix("")), path.name, path.stem} for path in paths]
        for name in read_names(self.config.held_out):
            found = [i for i, photo in enumerate(photos) if name == photo]
            found = found or [i for i, known in enumerate(forms) if name in known]
            if len(found) != 1:
                fits = f"which fits {len(found)} photos of the scene: correct the list"
                raise UserError(f"{self.config.held_out} names {name}, {fits}")
            indices += found
        return indices

    def _get_all_images_and_cameras(self, recon_dir: Path) -> dict:
        """Build the parent's frames, sorted by name, so that interval splits don't depend on COLMAP's ids."""
        frames = [self._frame(tracked) for tracked in self.reconstruction.photos.values()]
        applied = np.eye(4)[:3][[0, 2, 1]]
        applied[2] *= -1
        return {"frames": frames, "camera_model": "PINHOLE", "applied_transform": applied.tolist()}

    @cached_property
    def _origin(self) -> np.ndarray:
        """Center of the cameras, which is subtracted from positions as the origin while they are in float64.
        The parent casts to float32, which resolves map coordinates (millions of meters) only to half a
        meter."""
        return np.zeros(3) if self.config.center_method == "none" else self._centers.mean(axis=0)

    @property
    def _centers(self) -> np.ndarray:
        return np.array([tracked.center for tracked in self.reconstruction.photos.values()])

    @property
    def _cameras_are_apart(self) -> bool:
        """Whether cameras are far enough apart to scale the scene by their distance."""
        centers = self._centers
        distances = np.linalg.norm(self.reconstruction.points - centers.mean(axis=0), axis=1)
        typical = np.median(distances) if len(distances) else 0.0
        return bool(np.ptp(centers, axis=0).max() > 1e-6 * typical)

    def _load_3D_points(self, colmap_path: Path, transform_matrix: torch.Tensor, scale_factor: float) -> dict:
        """Return the model's points in the scene's frame, with their colors."""
        transform = transform_matrix.double()
        points = torch.from_numpy(self.reconstruction.points - self._origin)
        return {
            "points3D_xyz": (scale_factor * (points @ transform[:, :3].T + transform[:, 3])).float(),
            "points3D_rgb": torch.from_numpy(self.reconstruction.colors),
        }

    def _frame(self, tracked: TrackedPhoto) -> dict:
        world_from_camera = np.linalg.inv(np.vstack([tracked.camera_from_world, [0, 0, 0, 1]]))
        world_from_camera[:3, 3] -= self._origin
        world_from_camera[:3, 1:3] *= -1  # OpenCV axes to OpenGL's
        world_from_camera = world_from_camera[[0, 2, 1, 3]]  # COLMAP assumes gravity along -y; here z is up
        world_from_camera[2] *= -1
        path, lens = (self._images_folder / tracked.name).as_posix(), tracked.lens
        intrinsics = {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
        size = {"w": tracked.width, "h": tracked.height}
        place = {"file_path": path, "transform_matrix": world_from_camera, "camera_model": "PINHOLE"}
        return place | intrinsics | size

    @property
    def _images_folder(self) -> Path:
        return self.config.data / self.config.images_path

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """The model with its usable photos alone. Which are left out, and why, is logged once."""
        model = read_reconstruction(self.config.data / self.config.colmap_path)
        self.photos, self._left_out, usable = usable_photos(
            model, self._images_folder, self._mask_path, self.config.follow_links
        )
        if len(self.photos) == 1:
            need = "a scene needs at least two, one to learn from and one to hold out"
            raise UserError(f"{self.config.data} has one usable photo: {need}")
        if not self.photos:
            raise UserError(
                f"none of the model's {len(self._left_out)} photos can be used; "
                f"the first: {next(iter(self._left_out.values()))}. Name the photos' folder with "
                f"`lang3dxl-colmap --images-path FOLDER` after the other options"
            )
        if self._left_out:
            CONSOLE.log(f"[yellow]{len(self._left_out)} photos of the model are left out:[/yellow]")
            for name, why in self._left_out.items():
                CONSOLE.log(f"  {escape(printable(f'{name}: {why}'))}")
        self._mention_what_is_not_used()
        return usable

    def _mask_path(self, name: str) -> Path | None:
        """Find the photo's mask: the same name with an image suffix, or COLMAP's form `photo.jpg.png`."""
        if self.config.masks_path is None:
            return None
        return find_mask(self.config.data / self.config.masks_path, name, self.config.follow_links)

    def _mention_what_is_not_used(self) -> None:
        """Log other models beside the one in use, and photos missing from it."""
        model = self.config.data / self.config.colmap_path
        # COLMAP's mapper leaves its models in one folder: 0, 1, …
        beside = sorted(model.parent.glob("[0-9]*")) if model.name.isdigit() else []
        others = [f for f in beside if f != model and f.name.isdigit() and any(f.glob("images.*"))]
        if others:
            counts = (f"{f.relative_to(self.config.data)} with {photos_in_model(f)}" for f in others)
            CONSOLE.log(
                f"[yellow]{self.config.data} has {len(others) + 1} models; used is {self.config.colmap_path} "
                f"with {photos_in_model(model)} photos.[/yellow] There are also {', '.join(counts)}: choose "
                "with `lang3dxl-colmap --colmap-path FOLDER` after all other options"
            )
        names = photos_below(self._images_folder)
        unknown = [n for n in names if self._images_folder / n not in self.photos and n not in self._left_out]
        if unknown:
            CONSOLE.log(
                f"{len(unknown)} photos of {self._images_folder} are not in the COLMAP model and not used: "
                f"{escape(some(unknown))}"
            )


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
        scene = SceneRecord.read(self.config.run / SCENE_FILE)
        chosen = [photo for photo in scene.photos if (photo.split == "train") == (split == "train")]
        chosen = chosen or scene.photos  # with --eval-mode all, no photo is held out
        photos = [photo.photo(Path(scene.data)) for photo in chosen]
        poses = torch.tensor([photo.camera_to_world for photo in chosen], dtype=torch.float32)
        cameras = to_nerfstudio([photo.lens for photo in photos], poses)
        return DataparserOutputs(
            image_filenames=[photo.path for photo in photos],
            cameras=cameras,
            scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])),
            metadata={
                "photos": photos,
                # The checkpoint brings its own Gaussians, so start with as few as possible.
                "points3D_xyz": torch.eye(4)[:, :3],
                "points3D_rgb": torch.zeros(4, 3),
            },
            dataparser_transform=torch.tensor(scene.transform, dtype=torch.float32),
            dataparser_scale=scene.scale,
        )


def recorded_scene(run: Path | None) -> RecordedSceneDataParserConfig | None:
    """Return the settings for the scene recorded in a run's folder; None if there is none."""
    if run is None or not (run / SCENE_FILE).is_file():
        return None
    return RecordedSceneDataParserConfig(run=run)


# ── the choice for --data ─────────────────────────────────────────────────────────────────────────────────


def parser_for(
    parser: PhotoCollectionDataParserConfig, cache_dir: Path | None, may_reconstruct: bool
) -> DataParserConfig:
    """Choose the dataparser for `parser.data`. Photos without a model are reconstructed, if allowed; a video
    becomes a folder of frames. A folder with only a transforms.json gets nerfstudio's own parser. Raises
    UserError if the photos don't make a scene."""
    data = expanded(parser.data).absolute()
    if is_video(data) or (not data.exists() and frames_folder(data).is_dir()):
        data = parser.data = extract_frames(data) if may_reconstruct else frames_folder(data)
    if parser.colmap_path != type(parser)().colmap_path:  # named, or found when its run began
        return parser
    folders = [*MODEL_FOLDERS, OWN_MODEL]
    work = None if cache_dir is None else expanded(cache_dir).absolute() / "reconstruction"
    if work is not None and data.is_dir() and shows_these(work, data):
        folders.append(work / "sparse/0")
    known = find_colmap_model(data, folders)
    if known is not None:
        parser.colmap_path = known
    elif (data / TRANSFORMS).is_file():
        CONSOLE.log(f"{data} has a {TRANSFORMS} and no COLMAP model: read as nerfstudio-data")
        return NerfstudioDataParserConfig(data=data)
    elif may_reconstruct and data.is_dir() and find_photos(data).names:
        data, model = reconstruct_scene(data, cache_dir)
        parser.colmap_path = model.relative_to(data) if model.is_relative_to(data) else model
    elif may_reconstruct and data.is_dir() and not any(data.iterdir()):
        raise UserError(f"{data} is empty: give the folder with your photos")
    return parser


silence_libraries()  # nerfstudio imports this module before the libraries that warn

photo_collection = DataParserSpecification(
    config=PhotoCollectionDataParserConfig(),
    description="A folder of photos with a COLMAP model: images/, sparse/0/, optionally masks/.",
)
