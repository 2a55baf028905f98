"""Reading and validating a COLMAP model: cameras, poses, 3D points and their tracks."""

from __future__ import annotations

import signal
import struct
import threading
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np  # before pycolmap: in the other order, Pillow's PNG writer aborts the process
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from lang3dxl_ns.common.checks import FARTHEST
from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError, is_plain
from lang3dxl_ns.common.files import open_file
from lang3dxl_ns.scene.camera import HasLens, Lens, check_pose

if TYPE_CHECKING:
    import pycolmap

PERSPECTIVE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE_MODELS = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
"""COLMAP's fisheye camera models. Like `PERSPECTIVE_MODELS`, they have OpenCV's distortion, with parameters
in OpenCV's order."""


@dataclass(frozen=True, eq=False)
class TrackedPhoto(HasLens):
    """Photo of a COLMAP model: lens, pose and the 3D points tracked in it."""

    name: str
    lens: Lens
    camera_from_world: Float[Array, "3 4"]
    """Pose, world → camera, in COLMAP's camera frame: x right, y down, z forward."""
    points: Float[Array, "n 3"]
    """Tracked points, world units."""
    pixels: Float[Array, "n 2"]
    """Positions of the points in the (distorted) photo."""
    quarter_turns: int = 0
    """Clockwise quarter turns from the file's pixels as stored to this photo's."""

    @property
    def center(self) -> Float[Array, "3"]:
        """Position of the camera in the world."""
        return -self.camera_from_world[:, :3].T @ self.camera_from_world[:, 3]

    def resized(self, width: int, height: int) -> TrackedPhoto:
        """Return the photo at another resolution."""
        factor = [width / self.width, height / self.height]
        return replace(self, lens=self.lens.resized(width, height), pixels=self.pixels * factor)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """COLMAP model: its photos, sorted by name, and its points with their colors."""

    photos: dict[str, TrackedPhoto]
    points: Float[Array, "m 3"]
    colors: UInt8[Array, "m 3"]


def load_pycolmap() -> ModuleType:
    """Import pycolmap, and restore the Python SIGTERM handler that its import replaces. pycolmap's handler
    prints a stack trace and kills the process."""
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if threading.current_thread() is threading.main_thread():  # only the main thread may handle signals
        signal.signal(signal.SIGTERM, signal.SIG_DFL if handler is None else handler)
    return pycolmap


def read_reconstruction(model_dir: Path) -> Reconstruction:
    """Read a COLMAP model (.bin or .txt) with its tracks. Raises UserError for a missing, damaged or empty
    one, and for a camera model that OpenCV can't undistort."""
    model = _read_model(Path(model_dir))
    images = {
        name: image for i, image in model.images.items() if image.has_pose and (name := _name(i, image))
    }
    if not images:
        raise UserError(f"the COLMAP model in {model_dir} has no photo with a pose: run the mapper again")
    # Drop NaN, and coordinates whose squares overflow float32.
    points = {i: point for i, point in model.points3D.items() if (np.abs(point.xyz) < FARTHEST).all()}
    if len(points) < len(model.points3D):
        say(f"{len(model.points3D) - len(points)} points of {model_dir} are invalid and skipped")
    positions = {i: point.xyz for i, point in points.items()}
    return Reconstruction(
        photos={
            name: _tracked_photo(images[name], model.cameras[images[name].camera_id], positions)
            for name in sorted(images)
        },
        points=np.array(list(positions.values()), dtype=np.float64).reshape(-1, 3),
        colors=np.array([point.color for point in points.values()], dtype=np.uint8).reshape(-1, 3),
    )


def _name(number: int, image: pycolmap.Image) -> str | None:
    """Return a photo's name; if it can't be used, log the reason and return None."""
    left_out = "of the COLMAP model is left out: its name"
    try:
        if is_plain(image.name):
            return image.name
        say(f"photo {some([image.name])} {left_out} has control characters; rename it")
    except UnicodeDecodeError:
        say(
            f"photo {number} {left_out} is not UTF-8; rename its file (convmv -f latin1 -t utf8 --notest "
            "images/*) and make the model again"
        )
    return None


def photos_in_model(model_dir: Path) -> int:
    """Count the photos in a COLMAP model from the header or lines of its images file alone."""
    binary, text = model_dir / "images.bin", model_dir / "images.txt"
    if binary.is_file():
        with binary.open("rb") as file:
            return int.from_bytes(file.read(8), "little")
    with text.open(errors="replace") as lines:
        return sum(not line.startswith("#") for line in lines) // 2  # each is followed by a line of keypoints


def _read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read pycolmap's model. Raises UserError with the reason if it can't be read."""
    pycolmap = load_pycolmap()
    parts = ("cameras", "images", "points3D")
    if not any(all((folder / (part + ending)).is_file() for part in parts) for ending in (".bin", ".txt")):
        raise UserError(
            f"no COLMAP model in {folder}: looked for cameras, images and points3D, .bin or .txt. Give the "
            "folder that holds them (usually sparse/0), or make one from photos: "
            "lang3dxl reconstruct --data PHOTOS"
        )
    for path in (*folder.glob("*.bin"), *folder.glob("*.txt")):
        if not path.is_file():
            raise UserError(f"{path} is not a regular file: remove it, or copy the model again")
    check_binary_model(folder)
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, IndexError, RuntimeError, UnicodeDecodeError, MemoryError) as error:
        raise UserError(f"the COLMAP model in {folder} is damaged, copy or make it again: {error}") from error


def _tracked_photo(
    image: pycolmap.Image, camera: pycolmap.Camera, positions: dict[int, Array]
) -> TrackedPhoto:
    distortion, fisheye = _distortion(image.name, camera)
    lens = Lens(
        width=camera.width, height=camera.height, fx=camera.focal_length_x, fy=camera.focal_length_y,
        cx=camera.principal_point_x, cy=camera.principal_point_y, distortion=distortion, fisheye=fisheye,
    )  # fmt: skip
    pose = image.cam_from_world().matrix()
    try:
        lens.check()
        check_pose(pose.tolist())
    except ValueError as error:
        raise UserError(
            f"photo {image.name} has an impossible camera ({error}), remove it from the model: {camera}"
        ) from error
    tracked = [point for point in image.get_observation_points2D() if point.point3D_id in positions]
    points = np.array([positions[point.point3D_id] for point in tracked], dtype=np.float64).reshape(-1, 3)
    pixels = np.array([point.xy for point in tracked], dtype=np.float64).reshape(-1, 2)
    return TrackedPhoto(image.name, lens, pose, points, pixels)


def _distortion(name: str, camera: pycolmap.Camera) -> tuple[tuple[float, ...], bool]:
    """Return OpenCV's distortion coefficients for a COLMAP camera, and whether it is a fisheye. Raises
    UserError for a camera model that OpenCV can't undistort."""
    model = camera.model_name
    coefficients = tuple(camera.params[camera.extra_params_idxs()].tolist())
    coefficients += (0.0,) * (4 - len(coefficients))
    if model in PERSPECTIVE_MODELS:
        return coefficients if any(coefficients) else (), False
    if model in FISHEYE_MODELS:
        return coefficients, True
    raise UserError(
        f"photo {name} has a {model} camera, which can't be undistorted here: "
        "run colmap image_undistorter and use its images and model"
    )


# ── binary files ────────────────────────────────────────────────────────────────────────────────────────────
# pycolmap trusts every length in them, so that a damaged one can make it allocate all memory or read for
# hours. The layout follows COLMAP's documentation of its output format; numbers are little endian.

_POSE, _KEYPOINT, _OBSERVATION, _SENSOR = 7 * 8, 3 * 8, 2 * 4, 2 * 4


def check_binary_model(folder: Path) -> None:
    """Walk through the records of the binary files present. Raises UserError if a file ends early or
    continues after its last record."""
    for name, step in _STEPS.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
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
                f"the COLMAP model in {folder} is damaged, copy or make it again: the records of "
                f"{path.name} do not fill its {len(content)} bytes"
            )


@lru_cache
def _parameters(model: int) -> int:
    """Return the number of parameters of a camera model."""
    pycolmap = load_pycolmap()
    return len(pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 2, 2).params)


def _camera(content: bytes, place: int) -> int:
    return place + 24 + 8 * _parameters(_number("<i", content, place + 4))


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
