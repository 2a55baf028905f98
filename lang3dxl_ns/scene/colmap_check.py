"""Integrity check of a COLMAP model's binary files, since pycolmap trusts every length in them.

A damaged length can make it allocate all memory or read for hours. The layout follows COLMAP's documentation
of its output format; numbers are little endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import open_file
from lang3dxl_ns.scene.load_pycolmap import load_pycolmap

_POSE, _KEYPOINT, _OBSERVATION, _SENSOR = 7 * 8, 3 * 8, 2 * 4, 2 * 4


def check_binary_model(folder: Path) -> None:
    """Walk through the records of the binary files present. Raises UserError if a file ends early or
    continues after its last record."""
    for name, step in _STEPS.items():
        path = folder / f"{name}.bin"
        if path.is_file():
            _walk(path, step)


def _walk(path: Path, step: Callable[[bytes, int], int]) -> None:
    with open_file(path) as file:
        content = file.read()
    try:
        count, place = _number("<Q", content, 0), 8
        for _ in range(count):
            place = step(content, place)
            if place > len(content):
                break
    except (struct.error, ValueError, RuntimeError):
        place = -1
    if place != len(content):
        raise UserError(
            f"the COLMAP model in {path.parent} is damaged, copy or make it again: the records of "
            f"{path.name} do not fill its {len(content)} bytes"
        )


def _camera(content: bytes, place: int) -> int:
    model = _number("<i", content, place + 4)
    return place + 24 + 8 * _camera_parameters(model)


@lru_cache
def _camera_parameters(model: int) -> int:
    pycolmap = load_pycolmap()
    return len(pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 2, 2).params)


def _image(content: bytes, place: int) -> int:
    end_of_name = content.index(b"\0", place + 4 + _POSE + 4)
    return end_of_name + 1 + 8 + _KEYPOINT * _number("<Q", content, end_of_name + 1)


def _point(content: bytes, place: int) -> int:
    tracked = place + 8 + 3 * 8 + 3 + 8
    return tracked + 8 + _OBSERVATION * _number("<Q", content, tracked)


def _rig(content: bytes, place: int) -> int:
    sensors, place = _number("<I", content, place + 4), place + 8
    if sensors:
        place += _SENSOR  # the reference sensor
    for _ in range(sensors - 1):
        if place > len(content):
            break
        has_pose = _number("<B", content, place + _SENSOR)
        place += _SENSOR + 1 + _POSE * bool(has_pose)
    return place


def _frame(content: bytes, place: int) -> int:
    numbers = place + 8 + _POSE
    return numbers + 4 + (_SENSOR + 8) * _number("<I", content, numbers)


def _number(form: str, content: bytes, place: int) -> int:
    return struct.unpack_from(form, content, place)[0]


_STEPS = {"cameras": _camera, "images": _image, "points3D": _point, "rigs": _rig, "frames": _frame}
