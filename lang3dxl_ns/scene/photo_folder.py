"""Photos of a folder (flat, in images/, or in sub-folders), by camera; the sharpest frames of a video."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from PIL import ExifTags
from scipy import ndimage

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import DAMAGE, UserError
from lang3dxl_ns.common.files import expanded, read_json, replace_file
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

IMAGE_FOLDERS = (Path("images"), Path("dense/images"))
_NOT_PHOTOS = {
    *("masks", "mask", "segments", "depth", "depths", "normals", "ground_truth", "labels", "sparse", "dense"),
    *("lang3dxl_cache", "outputs", "renders", "colmap", "images_2", "images_4", "images_8"),
}
_KNOWN = (*PHOTO_SUFFIXES, *RAW_SUFFIXES, *OTHER_SUFFIXES)
_OWN = re.compile(r"\.[0-9a-f]{16}\.(png|jpg)$")
"""Ends of the names of pictures in a feature store, which --cache-dir may put into the photos' folder."""
_PHONE_PANORAMA = 6
"""Value that phones give to EXIF's CustomRendered."""
_WIDEST = 3.0
"""Largest ratio of sides of a photo; stitched panoramas are wider."""


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
    camera if all of their folder have the same size, as frames of a video have; otherwise each has its
    own."""
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


def readable(photos: PhotoFolder) -> tuple[PhotoFolder, dict[str, str]]:
    """Separate the photos with a readable header from the others, for which reasons are given."""
    good, bad = [], {}
    for name in photos.names:
        path = photos.folder / name
        if reason := unreadable(path):
            bad[name] = reason
            continue
        try:
            with open_picture(path) as image:
                image.load() if image.format == "GIF" else image.verify()  # which reads nothing of a GIF
            if _is_panorama(path):  # opened again: a verified picture tells nothing more
                bad[name] = "a panorama, which no lens takes: use single photos, or cut views out of it"
            else:
                good.append(name)
        except (OSError, NoPictureError) as error:
            bad[name] = f"the file is damaged ({error})"
    return PhotoFolder(photos.folder, tuple(good)), bad


def _is_panorama(path: Path) -> bool:
    """Return whether a picture is a panorama: by its note for viewers of spheres, by a phone's, or since it
    is wider than any lens takes."""
    with open_picture(path) as image:
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
        folders[:] = [f for f in folders if f.lower() not in _NOT_PHOTOS and not f.startswith((".", "_"))]
        if Path(parent).name in ("reconstruction", "adding"):
            folders[:] = [f for f in folders if f != "numbered"]
            files = [f for f in files if f != PICTURE.name or REPORT.name not in files]
        pictures = [
            file
            for file in files
            if Path(file).suffix.lower() in _KNOWN and not file.startswith(".") and not _OWN.search(file)
        ]
        lower = {name for file in pictures for name in (file.casefold(), Path(file).stem.casefold())}
        for file in pictures:
            if lower.isdisjoint(photos_of_mask(file.casefold())):
                names.append(Path(parent, file).relative_to(folder).as_posix())
    return sorted(names)


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
            focal = details.get(ExifTags.Base.FocalLengthIn35mmFilm) or details.get(ExifTags.Base.FocalLength)
            body = exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model)
            if any(body) and focal:
                return size, (*map(str, body), float(focal))
    return size, None


# ── videos ──────────────────────────────────────────────────────────────────────────────────────────────────

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts")
FRAMES_PER_SECOND = 2.0
MOST_FRAMES = 300
"""Maximum number of frames; the rate is reduced for a long video."""
_LOOK = (240, 135)  # pixels at which sharpness is judged; motion blur is visible there too
_COARSE = 15  # pixels of these that are averaged along each side to see change
_MOST_CHANGE = 95
"""Percentile of the changes between frames that larger ones are reduced to."""

_READING = ("-v", "error", "-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi,mpegts,mpeg")
"""Options of ffmpeg for untrusted files: a playlist, for example, could name other files and addresses."""
_SILENT = subprocess.DEVNULL  # ffmpeg takes what is typed, or a script's own input, for commands


def _reading(program: str, video: Path) -> list[str]:
    # A name may look like an option, or like another protocol.
    return [program, *_READING, "-i", f"file:{video.absolute()}"]


def is_video(path: Path) -> bool:
    """Return whether this is a file that ffmpeg may be able to read as a video."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def frames_folder(video: Path) -> Path:
    """Return the folder of a video's frames, which is beside the video and named after it."""
    return video.with_name(f"{video.stem}_photos")


def check_data(data: Path | None) -> None:
    """Raise UserError for a place without photos, before encoders are looked for. None is accepted."""
    place = Path() if data is None else expanded(data)
    known = is_video(place) or (place.is_file() and place.suffix == ".json")
    if not (known or place.is_dir() or frames_folder(place).is_dir()):
        raise UserError(f"{data} is not a folder: pass the one that holds your photos as --data, or a video")


def extract_frames(video: Path, rate: float = FRAMES_PER_SECOND, most: int = MOST_FRAMES) -> Path:
    """Write the sharpest frame of every interval of 1/`rate` seconds to `frames_folder`/images, upright,
    unless an earlier call did. Raises UserError without ffmpeg, for a file that is no video or a very short
    one, and for a folder with the frames of another video."""
    folder = frames_folder(video)
    made_of = folder / "lang3dxl_cache" / "video.json"
    this = known = [video.name, video.stat().st_size] if video.is_file() else None
    if (folder / "images").is_dir():
        with suppress(*DAMAGE):  # frames of an earlier version have no such file
            known = read_json(made_of)
        if this is not None and known != this:
            raise UserError(f"{folder} holds frames of another video: rename {video.name}, or remove them")
        return folder
    if shutil.which("ffmpeg") is None or shutil.which("ffprobe") is None:
        raise UserError(
            f"{video} is a video, and ffmpeg isn't installed: install it (apt install ffmpeg, conda install "
            "ffmpeg), or give a folder of frames"
        )
    duration = _duration(video)
    stretches = max(1, min(most, int(duration * rate + 0.01)))  # times are rounded
    say(f"{video.name}: {duration:.0f} s, the sharpest frame of each of {stretches} intervals")
    sharpness, change = _looks(video)
    if len(sharpness) < 3:
        raise UserError(f"{video} has {len(sharpness)} frames: a scene needs a walk of some seconds")
    _write(video, folder, _sharpest(sharpness, change, min(stretches, len(sharpness))))
    replace_file(made_of, json.dumps(this))
    return folder


def _sharpest(sharpness: Float[Array, " n"], change: Float[Array, " n"], stretches: int) -> Int[Array, " s"]:
    """Return the index of the sharpest frame of each of `stretches` parts of a video. A part is long in time
    or in change: where somebody stands still, frames tell nothing new, and a turn needs many to overlap."""
    steps = change.clip(max=np.percentile(change, _MOST_CHANGE))  # a cut or a flash is no way
    gone = np.cumsum(steps) / max(steps.sum(), 1e-9) if steps.any() else np.arange(len(steps)) / len(steps)
    progress = (np.arange(len(steps)) / len(steps) + gone) / 2
    ends = np.searchsorted(progress, np.arange(1, stretches) / stretches - 1e-9)
    parts = [part for part in np.split(np.arange(len(steps)), ends) if len(part)]
    return np.array([part[sharpness[part].argmax()] for part in parts])


def _looks(video: Path) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Compute, for every frame, downsized and gray, the variance of its Laplacian and its difference from the
    frame before, which is coarse so that noise is none."""
    width, height = _LOOK
    command = [*_reading("ffmpeg", video), "-an", "-vf", f"scale={width}:{height}"]
    command += ["-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    values, changes, before = [], [], None
    with subprocess.Popen(command, stdin=_SILENT, stdout=subprocess.PIPE, stderr=_SILENT) as process:
        assert process.stdout is not None
        while len(frame := process.stdout.read(width * height)) == width * height:
            gray = np.frombuffer(frame, np.uint8).reshape(height, width).astype(np.float32)
            values.append(ndimage.laplace(gray).var())
            coarse = gray.reshape(height // _COARSE, _COARSE, width // _COARSE, _COARSE).mean((1, 3))
            changes.append(0.0 if before is None else float(np.abs(coarse - before).mean()))
            before = coarse
    return np.array(values), np.array(changes)


def _duration(video: Path) -> float:
    """Return a video's length in seconds: as it says, or from its frames' times where it does not."""
    found = _probed(video, "stream=codec_type:format=duration")
    told = found.get("format", {}).get("duration")
    if told is not None:
        return float(told)
    # Browsers write the length nowhere: they begin a file before they know it.
    packets = _probed(video, "stream=codec_type:packet=pts_time").get("packets", [])
    times = sorted(float(packet["pts_time"]) for packet in packets if "pts_time" in packet)
    if not times:
        raise UserError(f"{video} does not tell the times of its frames: convert it (ffmpeg -i IN OUT.mp4)")
    return (times[-1] - times[0]) * len(times) / max(len(times) - 1, 1)


def _probed(video: Path, entries: str) -> dict[str, Any]:
    """Ask ffprobe about a video. Raises UserError for a file without a video that it reads."""
    asked = ("-select_streams", "v:0", "-show_entries", entries, "-of", "json")
    command = [*_reading("ffprobe", video), *asked]
    found = subprocess.run(command, stdin=_SILENT, capture_output=True, text=True, check=False)
    reason = " ".join(found.stderr.split())[-200:] or "it holds no pictures"
    with suppress(ValueError, KeyError):
        answer = json.loads(found.stdout)
        if answer["streams"]:
            return answer
    raise UserError(f"{video} is not a video that ffmpeg reads ({reason}): copy it again, or convert it")


def _write(video: Path, folder: Path, chosen: Int[Array, " s"]) -> None:
    """Write the chosen frames as JPEGs, all at once, so that a partial folder never looks complete."""
    partial = folder / ".images.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    wanted = "+".join(f"eq(n,{index})" for index in chosen)
    command = [*_reading("ffmpeg", video), "-an", "-vf", f"select='{wanted}'"]
    command += ["-fps_mode", "passthrough", "-q:v", "2", str(partial).replace("%", "%%") + "/frame_%05d.jpg"]
    done = subprocess.run(command, stdin=_SILENT, capture_output=True, text=True, check=False)
    if done.returncode or not any(partial.iterdir()):
        said = " ".join(done.stderr.split())[-200:]
        raise UserError(f"ffmpeg can't write frames of {video} to {folder} ({said}): free space, or move it")
    partial.rename(folder / "images")
