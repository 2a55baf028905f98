"""A photo on disk with its camera: read as RGB, undistorted, at any size."""

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

from lang3dxl_ns.errors import UserError

if TYPE_CHECKING:
    from lang3dxl_ns.preparation.physical_scale import PhotoGeometry


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Width and height of a photo at `scale`, at least one pixel each."""
    return max(1, round(width * scale)), max(1, round(height * scale))


@dataclass(frozen=True)
class Photo:
    """One photo on disk with its camera.

    Pixels are those of a `width` × `height` photo, origin at the corner of the top-left pixel. The file may
    have another size of the same shape: reading resizes it to the camera's. EXIF rotation is ignored, as in
    COLMAP.
    """

    name: str
    """As in the COLMAP model; may contain folders."""
    path: Path
    mask_path: Path | None
    """A picture of any size, bright where the photo counts."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """OpenCV's k1 k2 p1 p2 [k3 …], or k1 k2 k3 k4 of a fisheye."""
    fisheye: bool = False

    @classmethod
    def from_geometry(cls, geometry: PhotoGeometry, path: Path, mask_path: Path | None = None) -> Photo:
        """The photo with its camera of the COLMAP model, adapted to the size of the file on disk.

        So a folder of resized copies of the photos needs no model of its own. Raises UserError for an
        unreadable file and for one of another shape.
        """
        with _readable(path, geometry.name), Image.open(path) as image:
            width, height = image.size
        _check_shape(geometry.name, path, (width, height), (geometry.width, geometry.height))
        camera = geometry.resized(width, height)
        return cls(
            name=geometry.name,
            path=path,
            mask_path=mask_path,
            width=width,
            height=height,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            distortion=camera.distortion,
            fisheye=camera.fisheye,
        )

    def read(self, scale: float = 1.0) -> Float[Tensor, "h w 3"]:
        """RGB in 0..1 at `scaled_size`, undistorted: as a pinhole with the same fx, fy, cx, cy sees it.

        Black where the camera saw nothing of that view. Raises UserError for an unreadable file and for one
        of another shape than the camera's.
        """
        return self.read_uint8(scale).float() / 255

    def read_uint8(self, scale: float = 1.0) -> UInt8[Tensor, "h w 3"]:
        """`read` in 0..255, a quarter of the memory."""
        image = _read_rgb(self.path, self.name)
        _check_shape(self.name, self.path, image.size, (self.width, self.height))
        if self._distorted:
            image = Image.fromarray(self._undistort(np.asarray(image)))
        # Pillow's bilinear filter widens when shrinking, so that it averages the area under a pixel.
        image = image.resize(scaled_size(self.width, self.height, scale), Image.Resampling.BILINEAR)
        return torch.from_numpy(np.array(image))

    def read_mask(self, scale: float = 1.0) -> Bool[Tensor, "h w"] | None:
        """Where the photo counts: the mask is at least half bright, and undistortion had something to show.

        Has the size of `read(scale)`. None when that is everywhere: no mask file, no distortion.
        Raises UserError for an unreadable mask.
        """
        if self.mask_path is None and not self._distorted:
            return None
        mask = np.ones((self.height, self.width), dtype=bool)
        if self.mask_path is not None:
            grey = _read_rgb(self.mask_path, self.name).convert("L")
            mask = np.asarray(grey.resize((self.width, self.height), Image.Resampling.NEAREST)) >= 128
        if self._distorted:
            mask = self._undistort(mask * np.uint8(255)) >= 128
        size = scaled_size(self.width, self.height, scale)
        return torch.from_numpy(np.array(Image.fromarray(mask).resize(size, Image.Resampling.NEAREST)))

    def read_file(self, longer_side: int) -> UInt8[Tensor, "h w 3"]:
        """The file as it lies on disk, lens and all, shrunk to at most `longer_side` pixels.

        A mask drawn on this is one that `read_mask` understands. Raises UserError for an unreadable file.
        """
        image = _read_rgb(self.path, self.name)
        image.thumbnail((longer_side, longer_side), Image.Resampling.BILINEAR)
        return torch.from_numpy(np.array(image))

    def undistort_labels(self, labels: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
        """Labels drawn on the file, at any size, as `read` shows them: nearest, −1 where it shows nothing.

        Labels must fit into 32 bits.
        """
        if not self._distorted:
            return labels
        return torch.from_numpy(self._undistort(labels.numpy().astype(np.int32), nearest=True, empty=-1))

    def content_hash(self) -> str:
        """Hash of the file's bytes: changes when the photo does. The camera and the mask are not in it."""
        with _readable(self.path, self.name):
            return hashlib.blake2b(self.path.read_bytes(), digest_size=16).hexdigest()

    @property
    def _distorted(self) -> bool:
        return self.fisheye or any(self.distortion)

    def _undistort(
        self, image: UInt8[Array, "h w *c"] | Int32[Array, "h w"], nearest: bool = False, empty: int = 0
    ) -> Any:
        """The pinhole's view of a file of any size, `empty` where the camera saw nothing."""
        import cv2

        height, width = image.shape[:2]
        x, y = width / self.width, height / self.height
        # OpenCV's origin is the middle of the first pixel, hence -0.5.
        pinhole = np.array(
            [[self.fx * x, 0, self.cx * x - 0.5], [0, self.fy * y, self.cy * y - 0.5], [0, 0, 1]]
        )
        coefficients = np.array(self.distortion or (0.0,) * 4)
        module = cv2.fisheye if self.fisheye else cv2
        columns, rows = module.initUndistortRectifyMap(
            pinhole, coefficients, np.eye(3), pinhole, (width, height), cv2.CV_32FC1
        )
        blend = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        view = cv2.remap(image, columns, rows, blend, borderMode=cv2.BORDER_REPLICATE)
        view[~_seen(columns, rows)] = empty
        return view


def _seen(columns: Float32[Array, "h w"], rows: Float32[Array, "h w"]) -> Bool[Array, "h w"]:
    """Where the pixel of the file that an undistorted pixel shows is a true one.

    Not outside the file, and not where the distortion polynomial turns back beyond its range and shows the
    inside of the photo a second time (there the map mirrors: its determinant is negative).
    """
    height, width = columns.shape
    inside = (columns > -0.5) & (columns < width - 0.5) & (rows > -0.5) & (rows < height - 0.5)
    (column_dy, column_dx), (row_dy, row_dx) = np.gradient(columns), np.gradient(rows)
    return inside & (column_dx * row_dy > column_dy * row_dx)


@contextmanager
def _readable(path: Path, name: str) -> Iterator[None]:
    """Turn what Pillow raises for a missing or damaged file into a UserError."""
    try:
        yield
    except FileNotFoundError as error:
        raise UserError(f"photo {name}: no file {path}: put it there or leave the photo out") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise UserError(
            f"photo {name}: can't read {path} ({error}): remove it, or convert it to an 8-bit JPEG or PNG"
        ) from error


def _read_rgb(path: Path, name: str) -> Image.Image:
    """The file as 8-bit RGB: grey, CMYK and palettes converted, 16 bits reduced, transparency dropped."""
    with _readable(path, name), Image.open(path) as image:
        if image.mode == "F":
            raise ValueError("its pixels are floating-point numbers of unknown range")
        if image.mode.startswith("I"):  # 16-bit grey, which convert() would clip at 255
            grey = (np.asarray(image).clip(0, 65535) / 257).round().astype(np.uint8)
            return Image.fromarray(grey).convert("RGB")
        return image.convert("RGB")


def _check_shape(name: str, path: Path, size: tuple[int, int], camera: tuple[int, int]) -> None:
    """Accept the camera's size and resized copies of it, not crops or turned photos."""
    (width, height), (camera_width, camera_height) = size, camera
    if abs(width * camera_height / (height * camera_width) - 1) > 0.01:
        raise UserError(
            f"photo {name}: {path} has {width} × {height} pixels, but its COLMAP camera {camera_width} × "
            f"{camera_height}, which is another shape: use the photos that the model was made from"
        )
