"""Photo collection: a folder's photos with poses from a COLMAP model, a transforms.json, or photos alone."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import expanded, read_json
from lang3dxl_ns.common.pictures import open_picture
from lang3dxl_ns.preparation.foreground import find_mask
from lang3dxl_ns.scene.camera import Lens, check_pose, view_matrix
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto, read_reconstruction
from lang3dxl_ns.scene.companions import inside
from lang3dxl_ns.scene.photo import Photo, upright_in_model
from lang3dxl_ns.scene.photo_folder import extract_frames, find_photos, frames_folder, is_video, photos_below
from lang3dxl_ns.scene.reconstruct import reconstruct_scene

MODEL_FOLDERS = (Path("sparse/0"), Path("sparse"), Path("colmap/sparse/0"), Path("dense/sparse"))
OWN_MODEL = Path("lang3dxl_cache/reconstruction/sparse/0")
"""Folder of a model that is reconstructed here, if sparse/ is taken."""
TRANSFORMS = "transforms.json"
MaskOf = Callable[[str], Path | None]
_Read = tuple[dict[Path, Photo], dict[str, UserError], Reconstruction]


@dataclass(frozen=True)
class PhotoCollection:
    """Photos on disk with their poses."""

    folder: Path
    """Folder of the scene."""
    photos: list[Photo]
    """Usable photos, in the order of the reconstruction."""
    reconstruction: Reconstruction
    """Poses and points of the photos, in the frame of the file from which they were read."""
    left_out: dict[str, str]
    """Photos of that file that can't be used, with reasons."""


def read_collection(data: str | Path) -> PhotoCollection:
    """Read the photos of a folder with a COLMAP model or a transforms.json, a folder of photos alone, or a
    video. Photos without poses are reconstructed, which takes minutes. Raises UserError if there are no
    photos, or they can't be used, or the poses are damaged."""
    folder = expanded(data).absolute()
    if is_video(folder) or (not folder.exists() and frames_folder(folder).is_dir()):
        folder = extract_frames(folder)
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder: give the folder of the splat's photos as --data")
    model = find_colmap_model(folder)
    if model is None and (folder / TRANSFORMS).is_file():
        photos, left_out, reconstruction = read_transforms(folder / TRANSFORMS)
    else:
        place = folder / model if model is not None else reconstruct_scene(folder)[1]
        images, found = folder / images_path(folder), read_reconstruction(place)
        photos, left_out, reconstruction = usable_photos(
            found, images, lambda name: find_mask(folder / "masks", name)
        )
    if not photos:
        first = next(iter(left_out.values()), "it lists none")
        raise UserError(f"none of the {len(left_out)} photos of {folder} can be used; the first: {first}")
    reasons = {name: str(reason) for name, reason in left_out.items()}
    return PhotoCollection(folder, list(photos.values()), reconstruction, reasons)


def find_colmap_model(data: Path, folders: Sequence[Path] = (*MODEL_FOLDERS, OWN_MODEL)) -> Path | None:
    """Return the first of some folders (relative to `data`) that holds a COLMAP model; None if none does."""
    return next((folder for folder in folders if any((data / folder).glob("images.*"))), None)


def images_path(data: Path, named: Path = Path("images")) -> Path:
    """Return the photos' folder relative to the scene's: `named` if it has photos, else one that has."""
    if (data / named).is_dir() and any(photos_below(data / named)):
        return named
    return find_photos(data).folder.relative_to(data) if any(find_photos(data).names) else named


def usable_photos(
    reconstruction: Reconstruction, images: Path, mask_of: MaskOf, follow_links: bool = False
) -> _Read:
    """Find the photos of a COLMAP model on disk, below the folder `images`: usable ones by file, reasons for
    the others, and the model with the usable ones alone, turned like the files. `mask_of` finds a photo's
    foreground mask by its name; `follow_links` allows links that leave the folder."""
    photos, left_out = dict[Path, Photo](), dict[str, UserError]()
    kept = dict[str, TrackedPhoto]()
    for name, tracked in reconstruction.photos.items():
        path = images / name
        try:
            if not inside(images, name, follow_links).is_file():
                raise UserError(f"there is no {path}")
            turned = upright_in_model(tracked, path)
            photos[path], kept[name] = Photo.from_model(turned, path, mask_of(name)), turned
        except UserError as reason:
            left_out[name] = reason
    return photos, left_out, replace(reconstruction, photos=kept)


# ── transforms.json ─────────────────────────────────────────────────────────────────────────────────────


_LENSES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV_FISHEYE")


def read_transforms(path: Path) -> _Read:
    """Read the photos and poses of a transforms.json, as instant-ngp and nerfstudio write it: photos by file,
    reasons for those left out, and the reconstruction (without points) in its frame. Raises UserError if the
    file is damaged."""
    with readable(f"{path} can't be used", "correct it, or make it again"):
        content = read_json(path)
        photos, left_out, tracked = dict[Path, Photo](), dict[str, UserError](), dict[str, TrackedPhoto]()
        for frame in content["frames"]:
            name = _photo_name(path.parent, str(frame["file_path"]))
            try:
                photo, tracked[name] = _transforms_photo(path.parent, name, {**content, **frame})
                photos[photo.path] = photo
            except UserError as reason:
                left_out[name] = reason
    photos = dict(sorted(photos.items(), key=lambda item: item[1].name))
    nothing = np.zeros((0, 3))
    return photos, left_out, Reconstruction(dict(sorted(tracked.items())), nothing, nothing.astype(np.uint8))


def _photo_name(folder: Path, name: str) -> str:
    """Return a photo's name relative to the folder, with the suffix that instant-ngp leaves out."""
    if Path(name).is_absolute() and Path(name).is_relative_to(folder):
        name = Path(name).relative_to(folder).as_posix()
    name, endings = os.path.normpath(name), ("", ".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG")
    return next((name + ending for ending in endings if (folder / (name + ending)).is_file()), name)


def _transforms_photo(folder: Path, name: str, frame: Mapping[str, Any]) -> tuple[Photo, TrackedPhoto]:
    path = inside(folder, name, follow_links=True)
    if not path.is_file():
        raise UserError(f"there is no {path}")
    mask, matrix = frame.get("mask_path"), frame["transform_matrix"]
    check_pose(matrix)
    pose = view_matrix(torch.tensor(matrix[:3], dtype=torch.float64))[:3].numpy()
    nothing = np.zeros((0, 3)), np.zeros((0, 2))
    # Programs that write this file read the pixels as stored, whatever their EXIF orientation.
    tracked = upright_in_model(TrackedPhoto(name, _transforms_lens(frame, path, name), pose, *nothing), path)
    return Photo.from_model(tracked, path, None if mask is None else inside(folder, str(mask), True)), tracked


def _transforms_lens(frame: Mapping[str, Any], path: Path, name: str) -> Lens:
    model = str(frame.get("camera_model", "OPENCV"))
    if model not in _LENSES:
        raise UserError(f"photo {name} has a {model} camera: undistort it first (colmap image_undistorter)")
    if "w" in frame and "h" in frame:
        width, height = int(frame["w"]), int(frame["h"])
    else:
        with open_picture(path) as image:
            width, height = image.size
    angle = None if "fl_x" in frame else float(frame["camera_angle_x"])
    fx = float(frame["fl_x"]) if angle is None else width / 2 / math.tan(angle / 2)
    high = None if "fl_y" in frame else frame.get("camera_angle_y")
    square = fx if high is None else height / 2 / math.tan(float(high) / 2)
    fisheye = model == "OPENCV_FISHEYE" or bool(frame.get("is_fisheye"))  # instant-ngp's form
    if frame.get("k4") and not fisheye:
        raise UserError(f"photo {name} has a {model} camera with a fisheye's k4: undistort it first")
    names = ["k1", "k2", "k3", "k4"] if fisheye else ["k1", "k2", "p1", "p2", *["k3"] * bool(frame.get("k3"))]
    distortion = tuple(float(frame.get(key, 0.0)) for key in names)
    fy, cx, cy = (
        float(frame.get(key, usual))
        for key, usual in (("fl_y", square), ("cx", width / 2), ("cy", height / 2))
    )
    lens = Lens(width, height, fx, fy, cx, cy, distortion if fisheye or any(distortion) else (), fisheye)
    lens.check()
    return lens
