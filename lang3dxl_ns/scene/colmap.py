"""Reading and validating a COLMAP model: cameras, poses, 3D points and their tracks."""

from __future__ import annotations

import signal
import threading
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np  # before pycolmap: in the other order, Pillow's PNG writer aborts the process
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from lang3dxl_ns.common.checks import FARTHEST, expect
from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError, is_plain
from lang3dxl_ns.scene.camera import HasLens, Lens, check_pose
from lang3dxl_ns.scene.colmap_files import ModelCamera, ModelFiles, ModelPhoto, read_model_files

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
    files = read_model_files(Path(model_dir))
    photos = [photo for photo in files.photos if _has_name(photo)]
    if not photos:
        raise UserError(f"the COLMAP model in {model_dir} has no photo with a pose: run the mapper again")
    names = [photo.name for photo in photos]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise UserError(f"the COLMAP model in {model_dir} lists {some(twice)} twice: remove one of the two")
    # Drop NaN, and coordinates whose squares overflow float32.
    sound = (np.abs(files.positions) < FARTHEST).all(axis=1)
    if not sound.all():
        say(f"{np.count_nonzero(~sound)} points of {model_dir} are invalid and skipped")
    if files.colorless:
        say(f"{files.colorless} points of {model_dir} have no color and are gray")
    rows = dict(zip(files.numbers[sound].tolist(), range(int(sound.sum())), strict=True))
    rows.pop(-1, None)  # the number of no point, which keypoints without one have
    positions = files.positions[sound]
    tracked = {photo.name: _tracked_photo(photo, files, rows, positions) for photo in photos}
    return Reconstruction(dict(sorted(tracked.items())), positions, files.colors[sound])


def _has_name(photo: ModelPhoto) -> bool:
    """Return whether a photo has a name that can be used; if not, log the reason."""
    if is_plain(photo.name):
        return True
    if any("\ud800" <= character <= "\udfff" for character in photo.name):
        say(
            f"photo {photo.number} of the COLMAP model is left out: its name is not UTF-8; rename its file "
            "(convmv -f latin1 -t utf8 --notest images/*) and make the model again"
        )
    else:
        say(
            f"photo {some([photo.name])} of the COLMAP model is left out: its name has control characters; "
            "rename it"
        )
    return False


def photos_in_model(model_dir: Path) -> int:
    """Count the photos in a COLMAP model; 0 if it can't be read."""
    try:
        return len(read_model_files(model_dir).photos)
    except (UserError, OSError):
        return 0


def _tracked_photo(
    photo: ModelPhoto, files: ModelFiles, rows: dict[int, int], positions: Float[Array, "m 3"]
) -> TrackedPhoto:
    from scipy.spatial.transform import Rotation  # which opening a scene file does not need

    camera = files.cameras.get(photo.camera)
    if camera is None:
        raise UserError(f"photo {photo.name} has the camera {photo.camera}, which the COLMAP model lacks")
    distortion, fisheye = _distortion(photo.name, camera)
    (fx, fy), (cx, cy) = camera.focal, camera.center
    lens = Lens(camera.width, camera.height, fx, fy, cx, cy, distortion, fisheye)
    length = float(np.linalg.norm(photo.quaternion))
    try:
        lens.check()
        expect(1e-6 < length < FARTHEST, "its rotation is no quaternion")
        turn = Rotation.from_quat(photo.quaternion[[1, 2, 3, 0]]).as_matrix()
        pose = np.column_stack([turn, photo.translation])
        check_pose(pose.tolist())
    except ValueError as error:
        raise UserError(
            f"photo {photo.name} has an impossible camera ({error}), remove it from the model: {camera}"
        ) from error
    chosen = np.array([rows.get(number, -1) for number in photo.points.tolist()], dtype=np.int64)
    seen = chosen >= 0
    return TrackedPhoto(photo.name, lens, pose, positions[chosen[seen]], photo.pixels[seen])


def _distortion(name: str, camera: ModelCamera) -> tuple[tuple[float, ...], bool]:
    """Return OpenCV's distortion coefficients for a COLMAP camera, and whether it is a fisheye. Raises
    UserError for a camera model that OpenCV can't undistort."""
    coefficients = camera.extra + (0.0,) * (4 - len(camera.extra))
    if camera.model in PERSPECTIVE_MODELS:
        return coefficients if any(coefficients) else (), False
    if camera.model in FISHEYE_MODELS:
        return coefficients, True
    raise UserError(
        f"photo {name} has a {camera.model} camera, which can't be undistorted here: "
        "run colmap image_undistorter and use its images and model"
    )
