"""Finding the photos of a folder (flat, in images/, or in sub-folders), and grouping them by camera."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.pictures import NoPictureError, open_picture

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".gif")
UNREADABLE_SUFFIXES = (".heic", ".heif", ".avif", ".dng", ".cr2", ".nef", ".arw")
"""Suffixes of photos that can't be decoded here."""
IMAGE_FOLDERS = (Path("images"), Path("dense/images"))
_NOT_PHOTOS = {
    *("masks", "mask", "segments", "depth", "depths", "normals", "ground_truth", "labels", "sparse", "dense"),
    *("lang3dxl_cache", "outputs", "renders", "colmap", "images_2", "images_4", "images_8"),
}


@dataclass(frozen=True)
class PhotoFolder:
    """Folder with its photos, named relative to it and sorted."""

    folder: Path
    names: tuple[str, ...]


def find_photos(data: Path) -> PhotoFolder:
    """Find the photos of a scene's folder. They are those in images/ or dense/images/ if there are any,
    otherwise all in the folder and its sub-folders, except masks, results and the like. Links to folders are
    not followed. Raises UserError for a folder that doesn't exist."""
    if not data.is_dir():
        raise UserError(f"{data} is not a folder: give the folder with your photos, or a video")
    found = (PhotoFolder(f, tuple(photos_below(f))) for f in (*map(data.joinpath, IMAGE_FOLDERS), data))
    return next((photos for photos in found if photos.names), PhotoFolder(data, ()))


def shared_cameras(photos: PhotoFolder) -> list[list[str]]:
    """Group the names by camera and lens: by maker, model, focal length and size. Photos without EXIF share a
    camera if all of them have the same size; otherwise each has its own."""
    groups: dict[tuple, list[str]] = {}
    silent: dict[str, tuple[int, int]] = {}
    for name in photos.names:
        size, lens = _size_and_lens(photos.folder / name)
        if lens is None:
            silent[name] = size
        else:
            groups.setdefault((size, *lens), []).append(name)
    if len(set(silent.values())) == 1:
        return [*groups.values(), list(silent)]
    return [*groups.values(), *([name] for name in silent)]


def readable(photos: PhotoFolder) -> tuple[PhotoFolder, dict[str, str]]:
    """Separate the photos with a readable header from the others, for which reasons are given."""
    good, bad = [], {}
    for name in photos.names:
        path = photos.folder / name
        if path.suffix.lower() in UNREADABLE_SUFFIXES:
            bad[name] = f"{path.suffix} can't be read here: convert it to JPEG or PNG"
            continue
        try:
            with open_picture(path) as image:
                image.verify()
            good.append(name)
        except (OSError, NoPictureError) as error:
            bad[name] = f"the file is damaged ({error})"
    return PhotoFolder(photos.folder, tuple(good)), bad


def photos_below(folder: Path) -> list[str]:
    """List the photos in a folder and its sub-folders, without masks, results and the like, sorted."""
    names = []
    for parent, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if f.lower() not in _NOT_PHOTOS and not f.startswith((".", "_"))]
        for file in files:
            path = Path(parent, file)
            if path.suffix.lower() in (*PHOTO_SUFFIXES, *UNREADABLE_SUFFIXES) and not file.startswith("."):
                names.append(path.relative_to(folder).as_posix())
    return sorted(names)


def _size_and_lens(path: Path) -> tuple[tuple[int, int], tuple | None]:
    """Read the size in pixels, and camera and focal length from EXIF, if present."""
    with open_picture(path) as image:
        size = image.size
        with suppress(Exception):  # damaged EXIF, which may hold anything
            exif = image.getexif()
            details = exif.get_ifd(ExifTags.IFD.Exif)
            focal = details.get(ExifTags.Base.FocalLengthIn35mmFilm) or details.get(ExifTags.Base.FocalLength)
            body = exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model)
            if any(body) and focal:
                return size, (*map(str, body), float(focal))
    return size, None
