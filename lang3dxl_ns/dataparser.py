"""Photo collections with a COLMAP model: a camera for every photo, masks, and the original scale kept."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.files import read_names
from lang3dxl_ns.older_config import ReadsOlder
from lang3dxl_ns.preparation.companions import inside
from lang3dxl_ns.preparation.foreground import find_mask
from lang3dxl_ns.preparation.photo import Photo
from lang3dxl_ns.preparation.physical_scale import (
    PhotoGeometry,
    Reconstruction,
    photos_in_model,
    read_reconstruction,
)
from lang3dxl_ns.preparation.progress import some

MODEL_FOLDERS = (Path("sparse/0"), Path("sparse"), Path("colmap/sparse/0"), Path("dense/sparse"))
IMAGE_FOLDERS = (Path("images"), Path("dense/images"))
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".gif")


@dataclass
class PhotoCollectionDataParserConfig(ReadsOlder, ColmapDataParserConfig):
    """A folder with images/ and a COLMAP model, and perhaps masks/."""

    _target: type = field(default_factory=lambda: PhotoCollectionDataParser)
    colmap_path: Path = Path("sparse/0")
    """COLMAP model, relative to the data folder; sparse, colmap/sparse/0 and dense/sparse are tried too."""
    images_path: Path = Path("images")
    """Photos, relative to the data folder; dense/images is tried too."""
    masks_path: Path | None = Path("masks")
    """Foreground masks, white = keep, named like the photos (.png or .jpg); a photo without one is used
    whole. --pipeline.datamanager.foreground has other sources."""
    held_out: Path | None = None
    """Text file that names the photos to hold out of training, one per line, with or without suffix; instead
    of every eighth. `lang3dxl evaluate split` makes one from ground truth."""
    follow_links: bool = False
    """Whether photos and masks may be symbolic links that lead out of their folder."""
    downscale_factor: int | None = 1
    """Left at 1: photos are resized as they are read (--pipeline.datamanager.camera-res-scale-factor)."""


@dataclass
class PhotoCollectionDataParser(ColmapDataParser):
    """Reads any COLMAP model, lens and size per photo. Photos are undistorted as they are read
    (`Photo.read`), so every camera handed on is a pinhole."""

    config: PhotoCollectionDataParserConfig

    def __init__(self, config: PhotoCollectionDataParserConfig):
        super().__init__(config)
        self.reconstruction: Reconstruction | None = None
        self.photos: dict[Path, Photo] = {}
        self._left_out: dict[str, UserError] = {}

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        data = self.config.data = Path(self.config.data).expanduser().absolute()
        if not data.is_dir():
            raise UserError(
                f"{data} is not a folder: pass the folder that holds images/ and sparse/0 as --data"
            )
        self.config.colmap_path = _first_folder(data, (self.config.colmap_path, *MODEL_FOLDERS), "*.*")
        self.config.images_path = _first_folder(data, (self.config.images_path, *IMAGE_FOLDERS), "*")
        if self.reconstruction is None:
            self._read_collection()
            self._mention_what_is_not_used()
        # The parent would demand a mask for every photo; ours are optional and found per photo.
        masks, scaled = self.config.masks_path, self.config.auto_scale_poses
        self.config.masks_path, self.config.auto_scale_poses = None, scaled and self._cameras_are_apart
        try:
            outputs = super()._generate_dataparser_outputs(split, **kwargs)
        finally:
            self.config.masks_path, self.config.auto_scale_poses = masks, scaled
        outputs.metadata["photos"] = [self.photos[path] for path in outputs.image_filenames]
        # From here on the transform is again that of the model's own coordinates.
        transform = outputs.dataparser_transform.double()
        transform[:, 3] -= transform[:, :3] @ torch.from_numpy(self._origin)
        outputs.dataparser_transform = transform.float()
        return outputs

    def _get_image_indices(self, image_filenames, split):
        if self.config.held_out is not None:
            held_out = self._held_out([self._name(path) for path in image_filenames])
            everything = np.arange(len(image_filenames))
            wanted = np.isin(everything, held_out, invert=split == "train")
            indices = everything[wanted]
        else:
            indices = super()._get_image_indices(image_filenames, split)
        if len(indices) == 0:
            raise UserError(
                f"the {split} split of {self.config.data} has no photo (of {len(image_filenames)} in all): "
                f"add photos, or choose another split with `lang3dxl-colmap --eval-mode …` after all options"
            )
        return indices

    def _held_out(self, photos: list[str]) -> list[int]:
        """Indices of the photos that the list names. Raises UserError where one of them isn't there."""
        assert self.config.held_out is not None
        indices = []
        for name in read_names(self.config.held_out):
            forms = [(p, str(PurePosixPath(p).with_suffix("")), PurePosixPath(p).stem) for p in photos]
            found = [i for i, known in enumerate(forms) if name in known]
            if len(found) != 1:
                raise UserError(
                    f"{self.config.held_out} names {name}, as {len(found)} photos of the scene are called: "
                    f"correct the list"
                )
            indices += found
        return indices

    def _get_all_images_and_cameras(self, recon_dir: Path) -> dict:
        """Frames for the parent, sorted by name (interval splits then do not depend on COLMAP's ids)."""
        assert self.reconstruction is not None
        frames = [self._frame(geometry) for geometry in self.reconstruction.photos.values()]
        applied = np.eye(4)[:3][[0, 2, 1]]
        applied[2] *= -1
        return {"frames": frames, "camera_model": "PINHOLE", "applied_transform": applied.tolist()}

    @cached_property
    def _origin(self) -> np.ndarray:
        """What is subtracted from positions while they are in float64: the middle of the cameras.

        The parent casts to float32, which resolves map coordinates (millions of metres) to half a metre.
        """
        assert self.reconstruction is not None
        if self.config.center_method == "none":
            return np.zeros(3)
        return np.mean([geometry.centre for geometry in self.reconstruction.photos.values()], axis=0)

    @property
    def _cameras_are_apart(self) -> bool:
        """Whether there is a distance between cameras that the scene can be scaled by."""
        assert self.reconstruction is not None
        centres = np.array([geometry.centre for geometry in self.reconstruction.photos.values()])
        distances = np.linalg.norm(self.reconstruction.points - centres.mean(axis=0), axis=1)
        typical = np.median(distances) if len(distances) else 0.0
        return bool(np.ptp(centres, axis=0).max() > 1e-6 * typical)

    def _load_3D_points(self, colmap_path: Path, transform_matrix: torch.Tensor, scale_factor: float) -> dict:
        """The model's points in the scene's frame, with their colours."""
        assert self.reconstruction is not None
        transform = transform_matrix.double()
        points = torch.from_numpy(self.reconstruction.points - self._origin)
        return {
            "points3D_xyz": (scale_factor * (points @ transform[:, :3].T + transform[:, 3])).float(),
            "points3D_rgb": torch.from_numpy(self.reconstruction.colours),
        }

    def _frame(self, geometry: PhotoGeometry) -> dict:
        world_from_camera = np.linalg.inv(np.vstack([geometry.camera_from_world, [0, 0, 0, 1]]))
        world_from_camera[:3, 3] -= self._origin
        world_from_camera[:3, 1:3] *= -1  # OpenCV axes to OpenGL's
        world_from_camera = world_from_camera[[0, 2, 1, 3]]  # COLMAP guesses gravity along -y; here z is up
        world_from_camera[2] *= -1
        return {
            "file_path": self._image_path(geometry.name).as_posix(),
            "transform_matrix": world_from_camera,
            "camera_model": "PINHOLE",
            "fl_x": geometry.fx,
            "fl_y": geometry.fy,
            "cx": geometry.cx,
            "cy": geometry.cy,
            "w": geometry.width,
            "h": geometry.height,
        }

    def _image_path(self, name: str) -> Path:
        return self._images_folder / name

    @property
    def _images_folder(self) -> Path:
        return self.config.data / self.config.images_path

    def _name(self, path: Path) -> str:
        return Path(path).relative_to(self.config.data / self.config.images_path).as_posix()

    def _read_collection(self) -> None:
        """The model's photos that can be used; says which are left out, and why."""
        reconstruction = read_reconstruction(self.config.data / self.config.colmap_path)
        left_out: dict[str, UserError] = {}
        for name, geometry in reconstruction.photos.items():
            path = self._image_path(name)
            try:
                if not inside(self._images_folder, name, self.config.follow_links).is_file():
                    raise UserError(f"there is no {path}")
                self.photos[path] = Photo.from_geometry(geometry, path, self._mask_path(name))
            except UserError as reason:
                left_out[name] = reason
        self._left_out = left_out
        if len(self.photos) == 1:
            raise UserError(
                f"{self.config.data} has one photo that can be used: a scene needs at least two, one to "
                f"learn from and one to hold out"
            )
        if not self.photos:
            raise UserError(
                f"none of the model's {len(left_out)} photos can be used; "
                f"the first: {next(iter(left_out.values()))}. Name the photos' folder with "
                f"`lang3dxl-colmap --images-path FOLDER` after the other options"
            )
        if left_out:
            CONSOLE.log(f"[yellow]{len(left_out)} photos of the model are left out:[/yellow]")
            for name, why in left_out.items():
                CONSOLE.log(f"  {escape(f'{name}: {why}')}")
        kept = {name: g for name, g in reconstruction.photos.items() if name not in left_out}
        self.reconstruction = replace(reconstruction, photos=kept)

    def _mask_path(self, name: str) -> Path | None:
        """The photo's mask: the same name with an image suffix, or COLMAP's form `photo.jpg.png`."""
        if self.config.masks_path is None:
            return None
        return find_mask(self.config.data / self.config.masks_path, name, self.config.follow_links)

    def _mention_what_is_not_used(self) -> None:
        """Other models beside the one that is read, and photos that it does not know."""
        model = self.config.data / self.config.colmap_path
        others = [folder for folder in _models_beside(model) if folder != model]
        if others:
            counts = (f"{f.relative_to(self.config.data)} with {photos_in_model(f)}" for f in others)
            CONSOLE.log(
                f"[yellow]{self.config.data} has {len(others) + 1} models; used is {self.config.colmap_path} "
                f"with {photos_in_model(model)} photos.[/yellow] There are also {', '.join(counts)}: choose "
                "with `lang3dxl-colmap --colmap-path FOLDER` after all other options"
            )
        known = set(self.photos)
        files = (p for p in sorted(self._images_folder.rglob("*")) if p.suffix.lower() in PHOTO_SUFFIXES)
        unknown = [p.relative_to(self._images_folder).as_posix() for p in files if p not in known]
        unknown = [name for name in unknown if name not in self._left_out]
        if unknown:
            CONSOLE.log(
                f"{len(unknown)} photos of {self._images_folder} are not in the COLMAP model and not used: "
                f"{escape(some(unknown))}"
            )


def _models_beside(model: Path) -> list[Path]:
    """The models that COLMAP's mapper left in one folder: 0, 1, …; just this one where it has no number."""
    if not model.name.isdigit():
        return [model]
    numbered = (folder for folder in model.parent.iterdir() if folder.name.isdigit())
    return sorted(folder for folder in numbered if any(folder.glob("images.*")))


def _first_folder(data: Path, candidates: tuple[Path, ...], contents: str) -> Path:
    """The first of the folders (relative to `data`) that exists and holds files; else the first named."""
    return next((c for c in candidates if any(p.is_file() for p in (data / c).glob(contents))), candidates[0])


photo_collection = DataParserSpecification(
    config=PhotoCollectionDataParserConfig(),
    description="A folder of photos with a COLMAP model: images/, sparse/0/, perhaps masks/.",
)
