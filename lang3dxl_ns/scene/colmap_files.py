"""Files of a COLMAP model, binary and text, as they are: cameras, photos with keypoints, points.

The layouts follow COLMAP's documentation of its output format. Every length in a file is compared with what
the file holds. What other programs leave out of text files (empty lines of keypoints, colors, tracks) may be
missing.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64, UInt8
from numpy import ndarray as Array

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import open_file
from lang3dxl_ns.common.pictures import color_bytes

PARTS = ("cameras", "images", "points3D")

_MODELS = {
    **{0: ("SIMPLE_PINHOLE", 1, 0), 1: ("PINHOLE", 2, 0), 2: ("SIMPLE_RADIAL", 1, 1), 3: ("RADIAL", 1, 2)},
    **{4: ("OPENCV", 2, 4), 5: ("OPENCV_FISHEYE", 2, 4), 6: ("FULL_OPENCV", 2, 8), 7: ("FOV", 2, 1)},
    **{8: ("SIMPLE_RADIAL_FISHEYE", 1, 1), 9: ("RADIAL_FISHEYE", 1, 2), 10: ("THIN_PRISM_FISHEYE", 2, 8)},
    **{11: ("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12), 12: ("SIMPLE_DIVISION", 1, 1), 13: ("DIVISION", 2, 1)},
    **{14: ("SIMPLE_FISHEYE", 1, 0), 15: ("FISHEYE", 2, 0), 16: ("EUCM", 2, 2)},
}
"""COLMAP's camera models by number: name, focal lengths, and parameters after the principal point."""
_SIZES = {name: (focals, extra) for name, focals, extra in _MODELS.values()}
_GRAY = 128


@dataclass(frozen=True)
class ModelCamera:
    """Camera of a model."""

    model: str
    width: int
    height: int
    focal: tuple[float, float]
    center: tuple[float, float]
    extra: tuple[float, ...]
    """Further parameters, in the model's order."""


@dataclass(frozen=True, eq=False)
class ModelPhoto:
    """Photo of a model with its keypoints."""

    number: int
    name: str
    """Name as written; bytes that are not UTF-8 are lone surrogates."""
    quaternion: Float[Array, "4"]
    """Rotation, world → camera, real part first."""
    translation: Float[Array, "3"]
    camera: int
    pixels: Float[Array, "n 2"]
    points: Int64[Array, " n"]
    """Number of each keypoint's point; −1 for none."""


@dataclass(frozen=True, eq=False)
class ModelFiles:
    """Contents of a model."""

    cameras: dict[int, ModelCamera]
    photos: list[ModelPhoto]
    numbers: Int64[Array, " m"]
    """Numbers of the points."""
    positions: Float[Array, "m 3"]
    colors: UInt8[Array, "m 3"]
    colorless: int = 0
    """Number of points without a color, which are gray."""


def read_model_files(folder: Path) -> ModelFiles:
    """Read a model's files, the binary ones if there are both. Raises UserError if there are none, or one is
    damaged."""
    kinds = {ending: [(folder / (part + ending)).exists() for part in PARTS] for ending in (".bin", ".txt")}
    ending = next((ending for ending, found in kinds.items() if all(found)), None)
    if ending is None:
        partly = next((ending for ending, found in kinds.items() if any(found)), None)
        lacks = [part + partly for part in PARTS if not (folder / (part + partly)).exists()] if partly else []
        missing = f"{', '.join(lacks)} is missing. " if lacks else ""
        raise UserError(
            f"no COLMAP model in {folder}: looked for cameras, images and points3D, .bin or .txt. "
            f"{missing}Give the folder that holds them (usually sparse/0), or make one from photos: "
            "lang3dxl reconstruct --data PHOTOS"
        )
    contents = []
    for path in (folder / (part + ending) for part in PARTS):
        if not path.is_file():
            raise UserError(f"{path} is not a regular file: remove it, or copy the model again")
        with open_file(path) as file:
            contents.append(file.read())
    return _binary(folder, *contents) if ending == ".bin" else _text(folder, *contents)


def _camera(model: str, size: tuple[int, int], params: tuple[float, ...]) -> ModelCamera:
    focals, extra = _SIZES[model]
    if len(params) != focals + 2 + extra:
        raise ValueError(f"a {model} camera has {focals + 2 + extra} parameters, not {len(params)}")
    first = focals + 2
    return ModelCamera(
        model, *size, (params[0], params[focals - 1]), (params[focals], params[first - 1]), params[first:]
    )


# ── binary files, little endian ─────────────────────────────────────────────────────────────────────────


def _binary(folder: Path, cameras: bytes, images: bytes, points: bytes) -> ModelFiles:
    known = dict(_whole(folder / "cameras.bin", cameras, _binary_camera))
    photos = list(_whole(folder / "images.bin", images, _binary_photo))
    rows = list(_whole(folder / "points3D.bin", points, _binary_point))
    table = np.array(rows, dtype=[("number", "<u8"), ("position", "<f8", 3), ("color", "u1", 3)])
    return ModelFiles(known, photos, table["number"].astype(np.int64), table["position"], table["color"])


def _whole(path: Path, content: bytes, read) -> Iterator:  # type: ignore[no-untyped-def, type-arg]
    """Read all records of a file. Raises UserError if it ends early or continues after its last record."""
    place = -1
    try:
        (count,), place = struct.unpack_from("<Q", content), 8
        for _ in range(count):
            record, place = read(content, place)
            yield record
    except (struct.error, ValueError, OverflowError):
        place = -1
    if place != len(content):
        raise UserError(
            f"the COLMAP model in {path.parent} is damaged, copy or make it again: the records of "
            f"{path.name} do not fill its {len(content)} bytes"
        )


def _binary_camera(content: bytes, place: int) -> tuple[tuple[int, ModelCamera], int]:
    number, model, width, height = struct.unpack_from("<IiQQ", content, place)
    if model not in _MODELS:
        raise UserError(
            f"camera {number} of the COLMAP model has the unknown camera model {model}: run colmap "
            "image_undistorter and use its images and model"
        )
    name, focals, extra = _MODELS[model]
    form = f"<{focals + 2 + extra}d"
    params = struct.unpack_from(form, content, place + 24)
    return (number, _camera(name, (width, height), params)), place + 24 + struct.calcsize(form)


_KEYPOINT = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])


def _binary_photo(content: bytes, place: int) -> tuple[ModelPhoto, int]:
    number, *pose, camera = struct.unpack_from("<I7dI", content, place)
    name = place + 64
    end = content.index(b"\0", name)
    (count,) = struct.unpack_from("<Q", content, end + 1)
    seen = np.frombuffer(content, _KEYPOINT, count, end + 9) if count else np.zeros(0, _KEYPOINT)
    text = content[name:end].decode("utf-8", "surrogateescape")
    turn, shift = np.array(pose[:4]), np.array(pose[4:])
    photo = ModelPhoto(number, text, turn, shift, camera, seen["pixel"], seen["point"])
    return photo, end + 9 + count * _KEYPOINT.itemsize


def _binary_point(content: bytes, place: int) -> tuple[tuple[int, tuple[float, ...], tuple[int, ...]], int]:
    number, x, y, z, red, green, blue, _, tracked = struct.unpack_from("<Q3d3BdQ", content, place)
    return (number, (x, y, z), (red, green, blue)), place + 51 + 8 * tracked


# ── text files ──────────────────────────────────────────────────────────────────────────────────────────


def _text(folder: Path, cameras: bytes, images: bytes, points: bytes) -> ModelFiles:
    known = dict(_text_cameras(folder / "cameras.txt", cameras))
    numbers, positions, colors, colorless = _text_points(folder / "points3D.txt", points)
    photos = _text_photos(folder / "images.txt", images)
    return ModelFiles(known, photos, numbers, positions, colors, colorless)


def _lines(content: bytes) -> Iterator[tuple[int, str]]:
    """Yield the lines with their numbers, without blank ones and comments. Windows' editors begin files with
    a byte order mark, and some write two bytes per character."""
    wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    text = content.decode("utf-16", "replace") if wide else content.decode("utf-8-sig", "surrogateescape")
    for number, line in enumerate(re.split(r"\r\n?|\n", text), 1):
        if (line := line.strip(" \t\r\0")) and not line.startswith("#"):
            yield number, line


def _bad(path: Path, number: int, line: str, what: str) -> UserError:
    return UserError(f"line {number} of {path} {what}, correct it or export the model again: {line:.80}")


def _text_cameras(path: Path, content: bytes) -> Iterator[tuple[int, ModelCamera]]:
    for number, line in _lines(content):
        words = line.split()
        model = words[1].upper() if len(words) > 1 else ""
        if len(words) > 1 and model not in _SIZES:
            raise UserError(
                f"camera {words[0]} in {path} has the camera model {words[1]:.40}, which is unknown: run "
                "colmap image_undistorter and use its images and model"
            )
        try:
            width, height = float(words[2]), float(words[3])
            if not (width.is_integer() and height.is_integer()):
                raise ValueError(f"its size is {width} × {height}")
            size = int(width), int(height)
            yield int(words[0]), _camera(model, size, tuple(map(float, words[4:])))
        except (ValueError, IndexError, OverflowError) as error:
            raise _bad(path, number, line, f"is not a camera ({error})") from error


def _text_photos(path: Path, content: bytes) -> list[ModelPhoto]:
    """Read photos. Each has a line, and its keypoints have the next one, which may be missing or blank: a
    line of numbers only whose count is a multiple of three is one of keypoints."""
    photos: list[ModelPhoto] = []
    for number, line in _lines(content):
        numbers = _numbers(line)
        if numbers is None or len(numbers) % 3:
            photos.append(_text_photo(path, number, line, numbers_only=numbers is not None))
        elif not photos or len(photos[-1].points):
            raise _bad(path, number, line, "has keypoints of no photo")
        else:
            seen = numbers.reshape(-1, 3)
            known = np.abs(seen[:, 2]) < 2**53  # NaN is not
            points = np.where(known, seen[:, 2], -1).astype(np.int64)
            photos[-1] = replace(photos[-1], pixels=seen[:, :2], points=points)
    return photos


def _numbers(line: str) -> Float[Array, " n"] | None:
    """Return the line's numbers; None if one of its words isn't one."""
    try:
        return np.array(list(map(float, line.split())))
    except ValueError:
        return None


def _text_photo(path: Path, number: int, line: str, numbers_only: bool) -> ModelPhoto:
    try:
        *words, name = line.split(maxsplit=9)  # a name may contain spaces
        pose = np.array(list(map(float, words[1:8])))
        photo, camera = int(words[0]), int(words[8])
        if len(words) < 9 or (numbers_only and abs(np.linalg.norm(pose[:4]) - 1) > 0.1):
            raise ValueError
    except (ValueError, IndexError) as error:
        raise _bad(path, number, line, "is neither a photo nor its keypoints") from error
    return ModelPhoto(photo, name, pose[:4], pose[4:], camera, np.zeros((0, 2)), np.zeros(0, np.int64))


def _text_points(
    path: Path, content: bytes
) -> tuple[Int64[Array, " m"], Float[Array, "m 3"], UInt8[Array, "m 3"], int]:
    numbers, positions, colors, colorless = [], [], [], 0
    for number, line in _lines(content):
        words = line.split(maxsplit=8)
        try:
            numbers.append(int(words[0]))
            positions.append(tuple(map(float, words[1:4])))
            given = len(words) >= 7
            colors.append(tuple(map(float, words[4:7])) if given else (np.nan,) * 3)
            colorless += not given
            if len(words) < 4:
                raise ValueError
        except (ValueError, OverflowError) as error:
            raise _bad(path, number, line, "is not a point") from error
    whole = np.array(colors, np.float64).reshape(-1, 3)
    known = np.isfinite(whole).all(axis=1)
    shades = np.full(whole.shape, _GRAY, np.uint8)
    given = whole[known].clip(0, 65535)
    shades[known] = color_bytes(given if (given % 1).any() else given.astype(np.int64))
    ids = np.array([n if abs(n) < 1 << 63 else -1 for n in numbers], np.int64)  # as for no point
    return ids, np.array(positions, np.float64).reshape(-1, 3), shades, colorless
