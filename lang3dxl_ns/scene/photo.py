"""A photo on disk with its lens: reading, undistortion, masks, resizing."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numpy import ndarray as Array
from PIL import Image
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.pictures import NoPictureError, open_picture
from lang3dxl_ns.scene.camera import Lens, scaled_size

if TYPE_CHECKING:
    from lang3dxl_ns.scene.colmap import TrackedPhoto


@dataclass(frozen=True)
class Photo:
    """One photo on disk with its lens.

    The file may have another size than the lens but the same aspect ratio: reading resizes it to the lens's.
    EXIF rotation is ignored, as in COLMAP.
    """

    name: str
    """As in the COLMAP model; may contain folders."""
    path: Path
    mask_path: Path | None
    """A picture of any size, bright on the foreground."""
    lens: Lens

    @property
    def width(self) -> int:
        """Of the lens, in pixels."""
        return self.lens.width

    @property
    def height(self) -> int:
        """Of the lens, in pixels."""
        return self.lens.height

    @classmethod
    def from_model(cls, tracked: TrackedPhoto, path: Path, mask_path: Path | None = None) -> Photo:
        """The photo with its lens from the COLMAP model, adapted to the size of the file on disk.

        So a folder of resized photos works with the same model. Raises UserError for an unreadable file and
        for another aspect ratio.
        """
        with _readable(path, tracked.name), open_picture(path) as image:
            size = image.size
        _check_shape(tracked.name, path, size, (tracked.width, tracked.height))
        return cls(tracked.name, path, mask_path, tracked.lens.resized(*size))

    def read(self, scale: float = 1.0) -> Float[Tensor, "h w 3"]:
        """RGB in 0..1 at `scaled_size`, undistorted: what a pinhole camera with the same fx, fy, cx, cy sees.

        Black where the photo does not reach. Raises UserError for an unreadable file and for another aspect
        ratio than the camera's.
        """
        return self.read_uint8(scale).float() / 255

    def read_uint8(self, scale: float = 1.0) -> UInt8[Tensor, "h w 3"]:
        """`read` in 0..255, for a quarter of the memory."""
        image = _read_rgb(self.path, self.name)
        _check_shape(self.name, self.path, image.size, (self.width, self.height))
        if self.lens.distorts:
            image = Image.fromarray(self._undistort(np.asarray(image)))
        # Pillow's bilinear filter widens when shrinking: it averages the area of each output pixel.
        image = image.resize(scaled_size(self.width, self.height, scale), Image.Resampling.BILINEAR)
        return torch.from_numpy(np.array(image))

    def read_mask(self, scale: float = 1.0) -> Bool[Tensor, "h w"] | None:
        """The foreground: where the mask is at least half bright and undistortion stays inside the photo.

        Same size as `read(scale)`. None if that is everywhere: no mask file and no distortion.
        Raises UserError for an unreadable mask.
        """
        if self.mask_path is None and not self.lens.distorts:
            return None
        mask = np.ones((self.height, self.width), dtype=bool)
        if self.mask_path is not None:
            gray = _read_rgb(self.mask_path, self.name).convert("L")
            mask = np.asarray(gray.resize((self.width, self.height), Image.Resampling.NEAREST)) >= 128
        if self.lens.distorts:
            mask = self._undistort(mask * np.uint8(255)) >= 128
        size = scaled_size(self.width, self.height, scale)
        return torch.from_numpy(np.array(Image.fromarray(mask).resize(size, Image.Resampling.NEAREST)))

    def read_file(self, longer_side: int) -> UInt8[Tensor, "h w 3"]:
        """The file as it is on disk, distorted, shrunk to at most `longer_side` pixels.

        A mask drawn on it can be read by `read_mask`. Raises UserError for an unreadable file.
        """
        image = _read_rgb(self.path, self.name)
        image.thumbnail((longer_side, longer_side), Image.Resampling.BILINEAR)
        return torch.from_numpy(np.array(image))

    def undistort_labels(self, labels: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
        """Labels drawn on the file (any size), undistorted like `read`: nearest pixel, −1 outside the photo.

        Labels must fit into 32 bits.
        """
        if not self.lens.distorts:
            return labels
        return torch.from_numpy(self._undistort(labels.numpy().astype(np.int32), nearest=True, empty=-1))

    def content_hash(self) -> str:
        """Hash of the file's bytes, without camera and mask."""
        with _readable(self.path, self.name):
            return hashlib.blake2b(self.path.read_bytes(), digest_size=16).hexdigest()

    def _undistort(
        self, image: UInt8[Array, "h w *c"] | Int32[Array, "h w"], nearest: bool = False, empty: int = 0
    ) -> Any:
        """A file of any size as seen by a pinhole camera; `empty` outside the photo."""
        import cv2

        height, width = image.shape[:2]
        lens = self.lens.resized(width, height)
        # OpenCV's origin is the center of the first pixel, hence -0.5.
        pinhole = lens.matrix.numpy() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        coefficients = np.array(lens.distortion or (0.0,) * 4)
        module = cv2.fisheye if lens.fisheye else cv2
        columns, rows = module.initUndistortRectifyMap(
            pinhole, coefficients, np.eye(3), pinhole, (width, height), cv2.CV_32FC1
        )
        blend = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        view = cv2.remap(image, columns, rows, blend, borderMode=cv2.BORDER_REPLICATE)
        view[~_seen(columns, rows)] = empty
        return view


def _seen(columns: Float32[Array, "h w"], rows: Float32[Array, "h w"]) -> Bool[Array, "h w"]:
    """Which pixels of the undistorted image sample a valid place in the file.

    Invalid are those outside the file, and those beyond the distortion polynomial's turning point, which show
    the inside of the photo a second time (there the map is mirrored: its determinant is negative).
    """
    height, width = columns.shape
    inside = (columns > -0.5) & (columns < width - 0.5) & (rows > -0.5) & (rows < height - 0.5)
    if min(height, width) < 2:  # too narrow to turn over
        return inside
    (column_dy, column_dx), (row_dy, row_dx) = np.gradient(columns), np.gradient(rows)
    return inside & (column_dx * row_dy > column_dy * row_dx)


@contextmanager
def _readable(path: Path, name: str) -> Iterator[None]:
    """Turn Pillow's exceptions for a missing or damaged file into a UserError."""
    try:
        yield
    except FileNotFoundError as error:
        raise UserError(
            f"photo {name}: there is no file {path}: put it there or leave the photo out"
        ) from error
    except (OSError, NoPictureError) as error:
        raise UserError(
            f"photo {name}: can't read {path} ({error}): remove it, or convert it to an 8-bit JPEG or PNG"
        ) from error


def _read_rgb(path: Path, name: str) -> Image.Image:
    """The file as 8-bit RGB: gray, CMYK and palettes converted, 16 bits reduced, transparency dropped."""
    with _readable(path, name), open_picture(path) as image:
        if image.mode == "F":
            raise ValueError("its pixels are floating-point numbers of unknown range")
        if image.mode.startswith("I"):  # 16-bit gray, which convert() would clip at 255
            gray = (np.asarray(image).clip(0, 65535) / 257).round().astype(np.uint8)
            return Image.fromarray(gray).convert("RGB")
        return image.convert("RGB")


def _check_shape(name: str, path: Path, size: tuple[int, int], camera: tuple[int, int]) -> None:
    """Accept the camera's aspect ratio (resized photos), not cropped or rotated photos."""
    (width, height), (camera_width, camera_height) = size, camera
    if abs(width * camera_height / (height * camera_width) - 1) > 0.01:
        raise UserError(
            f"photo {name}: {path} has {width} × {height} pixels, but its COLMAP camera {camera_width} × "
            f"{camera_height}, another aspect ratio: use the photos that the model was made from"
        )
