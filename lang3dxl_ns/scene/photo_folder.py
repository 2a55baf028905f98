"""Photos of a folder (flat, in images/, or in sub-folders), by camera."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image

from lang3dxl_ns.common.console import say, some, tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded, open_file
from lang3dxl_ns.common.pictures import (
    OTHER_SUFFIXES,
    PHOTO_SUFFIXES,
    RAW_SUFFIXES,
    NoPictureError,
    open_picture,
    unreadable,
)
from lang3dxl_ns.scene.masks import photos_of_mask
from lang3dxl_ns.scene.reconstruction import PICTURE, REPORT
from lang3dxl_ns.scene.video import VIDEO_SUFFIXES, frames_folder, is_video

IMAGE_FOLDERS = (Path("images"), Path("dense/images"))
_SMALLER = ("images_2", "images_4", "images_8")
"""Folders of copies of the photos at lower resolutions."""
_NOT_PHOTOS = {
    *_SMALLER,
    *("masks", "mask", "segments", "depth", "depths", "normals", "ground_truth", "labels", "sparse", "dense"),
    *("lang3dxl_cache", "outputs", "renders", "colmap", "confidence"),
    *("@eadir", "#recycle", "@recycle", "#snapshot", "$recycle.bin", "lost+found", "thumbnails", "thumbs"),
}
_KNOWN = (*PHOTO_SUFFIXES, *RAW_SUFFIXES, *OTHER_SUFFIXES)
_ARCHIVES = (".zip", ".rar", ".7z", ".tar", ".gz", ".tgz", ".livp")
_BEGINNINGS = re.compile(rb"\xff\xd8\xff|\x89PNG\r\n|GIF8|RIFF....WEBP|....ftyp(hei|mif1|avif)", re.DOTALL)
"""First bytes of pictures that are read."""
_OWN = re.compile(r"\.[0-9a-f]{16}\.(png|jpg)$")
"""Ends of the names of pictures in a feature store, which --cache-dir may put into the photos' folder."""
_PAGE_PHOTO = re.compile(r"photo\d+\.jpg")
_PHONE_PANORAMA = 6
"""Value that phones give to EXIF's CustomRendered."""
_WIDEST = 3.0
"""Largest ratio of sides of a photo; stitched panoramas are wider."""
_LEAST_SIDE = 16
"""Shorter side of a photo in pixels, below which COLMAP's stronger features crash."""


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
        raise _no_place(data)
    found = (PhotoFolder(f, tuple(photos_below(f))) for f in (*map(data.joinpath, IMAGE_FOLDERS), data))
    return next((photos for photos in found if photos.names), PhotoFolder(data, ()))


def check_data(data: Path | None) -> None:
    """Raise UserError for a place without photos, before encoders are looked for. None is accepted."""
    place = Path() if data is None else expanded(data)
    known = is_video(place) or (place.is_file() and place.suffix == ".json")
    if not (known or place.is_dir() or frames_folder(place).is_dir()):
        raise _no_place(place)


def _no_place(data: Path) -> UserError:
    if data.is_file() and data.suffix.lower() in _KNOWN:
        return UserError(f"{data} is one photo: give the folder that holds it and the others, {data.parent}")
    if data.is_file():
        kinds = f"a video ({', '.join(VIDEO_SUFFIXES)})"
        return UserError(f"{data} is neither a folder nor {kinds}: unpack or convert it, and give the result")
    return UserError(f"{data} is not a folder: give the folder with your photos, or a video")


def mention_passed_over(folder: Path) -> None:
    """Say what lies among a folder's photos and isn't read, though it may hold some."""
    found: dict[str, list[str]] = {}

    def closed(error: OSError) -> None:
        found.setdefault("folders that you may not read (allow it, or copy them)", []).append(error.filename)

    for parent, folders, files in os.walk(folder, onerror=closed):
        folders[:] = filter(_may_hold_photos, folders)
        links = "links to folders, which are not followed (copy the photos)"
        found.setdefault(links, []).extend(f for f in folders if Path(parent, f).is_symlink())
        stems = {Path(file).stem for file in files if Path(file).suffix.lower() in _KNOWN}
        for path in (Path(parent, file) for file in files):
            if what := _passed_over(path, stems):
                found.setdefault(what, []).append(path.relative_to(folder).as_posix())
    for what, names in found.items():
        if names:
            say(f"{folder} also holds {len(names)} {what}: {some(sorted(names), 3)}")


def _passed_over(path: Path, photos: Collection[str]) -> str | None:
    """Say what a file is, if it may hold photos and is none that is read. `photos` are the stems of those
    beside it: phones keep a short video with each."""
    suffix = path.suffix.lower()
    if path.name.startswith("."):
        return "photos that are only in iCloud (download them)" if suffix == ".icloud" else None
    if suffix in _ARCHIVES:
        return "archives (unpack them)"
    if suffix in VIDEO_SUFFIXES:
        live = path.stem in photos or path.stem.removesuffix("_HEIC") in photos
        also = "videos (give one instead of the folder, or later add it: lang3dxl reconstruct --add)"
        return None if live or frames_folder(path).is_dir() else also
    if suffix in (*_KNOWN, ".thm") or suffix.endswith("_original"):
        return None
    with suppress(OSError), open_file(path) as file:
        if _BEGINNINGS.match(file.read(16)):
            return "pictures under other endings (call them .jpg)"
    return None


def shared_cameras(photos: PhotoFolder) -> list[list[str]]:
    """Group the names by camera and lens: by maker, model, focal length with zoom, and size. Photos without
    EXIF share a camera if all of their folder have the same size, as frames of a video have; otherwise each
    has its own."""
    groups: dict[tuple, list[str]] = {}
    silent: dict[Path, dict[str, tuple[int, int]]] = {}
    for name in photos.names:
        size, lens = _size_and_lens(photos.folder / name)
        if lens is None:
            silent.setdefault(Path(name).parent, {})[name] = size
        else:
            groups.setdefault((size, *lens), []).append(name)
    found = list(groups.values())
    for sizes in silent.values():
        found += [list(sizes)] if len(set(sizes.values())) == 1 else [[name] for name in sizes]
    return found


def walks(photos: PhotoFolder) -> Iterator[list[str]]:
    """Yield the photos that one camera took in the same hour, in the order of time, by EXIF's maker, model,
    serial number and times. Photos without a time or model are in no walk."""
    taken: dict[tuple, list[tuple[str, str]]] = {}
    for name in photos.names:
        with suppress(Exception), open_picture(photos.folder / name) as image:  # EXIF may hold anything
            exif = image.getexif()
            details = exif.get_ifd(ExifTags.IFD.Exif)
            body = exif.get(ExifTags.Base.Make), exif[ExifTags.Base.Model]
            time = details[ExifTags.Base.DateTimeOriginal]  # as in 2026:05:01 10:59:30
            camera = *body, details.get(ExifTags.Base.BodySerialNumber), time[:13]
            fraction = details.get(ExifTags.Base.SubsecTimeOriginal, "")
            taken.setdefault(camera, []).append((f"{time}.{fraction}", name))
    yield from ([name for _, name in sorted(walk)] for walk in taken.values())


def readable(photos: PhotoFolder) -> tuple[PhotoFolder, dict[str, str]]:
    """Separate the photos that can be decoded from the others, for which reasons are given."""
    good, bad = [], {}
    for name in tracked(photos.names, "photos read"):
        path = photos.folder / name
        if reason := unreadable(path):
            bad[name] = reason
            continue
        try:
            with open_picture(path) as image:
                width, height = image.size
                image.draft("L", (100, 100))  # a JPEG is decoded to its end, in an eighth of the time
                image.load()
                panorama = _is_panorama(image)
            if panorama:
                bad[name] = "a panorama, which no single lens takes: use single photos, or cut out views"
            elif min(width, height) < _LEAST_SIDE:
                bad[name] = f"{width} × {height} pixels are too few to match: use a larger copy"
            else:
                good.append(name)
        except (OSError, NoPictureError) as error:
            bad[name] = f"the file is damaged ({error})"
    return PhotoFolder(photos.folder, tuple(good)), bad


def _is_panorama(image: Image.Image) -> bool:
    """Return whether an open picture is a panorama: by its note for viewers of spheres, by a phone's, or
    since it is wider than any lens takes."""
    note = image.info.get("xmp", b"")
    if b"GPano:ProjectionType" in (note.encode() if isinstance(note, str) else note):
        return True
    with suppress(Exception):  # damaged EXIF, which may hold anything
        details = image.getexif().get_ifd(ExifTags.IFD.Exif)
        if details.get(ExifTags.Base.CustomRendered) == _PHONE_PANORAMA:
            return True
    return max(image.size) > _WIDEST * min(image.size)


def photos_below(folder: Path) -> list[str]:
    """List the photos in a folder and its sub-folders, sorted, without results and the like, and without
    masks, in folders of their own or beside their photos."""
    names = []
    for parent, folders, files in os.walk(folder):
        folders[:] = filter(_may_hold_photos, folders)
        if Path(parent).name in ("reconstruction", "adding"):
            folders[:] = [f for f in folders if f != "numbered"]
            files = [f for f in files if f != PICTURE.name or REPORT.name not in files]
        ours = _results(Path(parent), files)
        pictures = [
            file
            for file in files
            if Path(file).suffix.lower() in _KNOWN and not file.startswith(".") and not _OWN.search(file)
            if file not in ours
        ]
        lower = {name for file in pictures for name in (file.casefold(), Path(file).stem.casefold())}
        for file in pictures:
            if lower.isdisjoint(photos_of_mask(file.casefold())):
                names.append(Path(parent, file).relative_to(folder).as_posix())
    return sorted(names)


def _results(folder: Path, files: Collection[str]) -> set[str]:
    """Return those of a folder's files that are pictures of `lang3dxl query`, `things` or `export --web`."""
    if folder.name.startswith("together") and (folder.parent / "query.json").is_file():
        return set(files)
    stems = [file.removesuffix(".overlay.png") for file in files if file.endswith(".overlay.png")]
    found = {f"{stem}.{kind}.png" for stem in stems for kind in ("overlay", "mask")}
    found |= {"things.png"} if "things.json" in files else set()
    return found | ({file for file in files if _PAGE_PHOTO.fullmatch(file)} if "page.js" in files else set())


def smaller_copies(folder: Path) -> list[str]:
    """List the copies of the photos of a folder at the highest of lower resolutions, relative to it. They
    stand for photos that aren't there."""
    found = ([f"{part}/{name}" for name in photos_below(folder / part)] for part in _SMALLER)
    return next(filter(None, found), [])


def _may_hold_photos(folder: str) -> bool:
    """Return whether a sub-folder of this name is searched for photos."""
    return folder.lower() not in _NOT_PHOTOS and not folder.startswith((".", "_"))


def files_below(folder: Path) -> Iterator[str]:
    """Yield all regular files in a folder and its sub-folders, without hidden ones and the cache."""
    for parent, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if f != "lang3dxl_cache" and not f.startswith(".")]
        for path in (Path(parent, file) for file in files if not file.startswith(".")):
            if path.is_file():
                yield path.relative_to(folder).as_posix()


def _size_and_lens(path: Path) -> tuple[tuple[int, int], tuple | None]:
    """Read the size in pixels, and camera and focal length from EXIF, if present."""
    with open_picture(path) as image:
        size = image.size
        with suppress(Exception):  # damaged EXIF, which may hold anything
            exif = image.getexif()
            details = exif.get_ifd(ExifTags.IFD.Exif)
            zoom = float(details.get(ExifTags.Base.DigitalZoomRatio) or 1)
            focal = details.get(ExifTags.Base.FocalLengthIn35mmFilm)
            focal = focal or zoom * float(details.get(ExifTags.Base.FocalLength, 0))
            body = exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model)
            if any(body) and focal:
                return size, (*map(str, body), float(focal))
    return size, None
