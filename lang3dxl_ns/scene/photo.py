"""Photo on disk with its lens: reading, turning upright, undistortion, masks, resizing.

Phones store the sensor's pixels, and note in EXIF how many quarter turns bring them upright. COLMAP reads the
pixels as stored. So pixels, lens and pose of a model's photo are turned together, which is exact.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numpy import ndarray as Array
from PIL import ExifTags, Image
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import content_digest
from lang3dxl_ns.common.pictures import NoPictureError, mask_values, open_picture, rgb_pixels, see_through
from lang3dxl_ns.scene.camera import HasLens, Lens, scaled_size

if TYPE_CHECKING:
    from lang3dxl_ns.scene.colmap import TrackedPhoto

_LARGE = 1_500_000
"""Pixels of a file above which the JPEG decoder shrinks it: in half of the time, 50 dB from exact."""
_LEAST_SEEN = 0.1
"""Share of a pinhole's view that a photo must have. Wide lenses leave about half."""


@dataclass(frozen=True)
class Photo(HasLens):
    """Photo on disk with its lens, read upright and at the lens's size, whose aspect ratio the file has. No
    other code decodes photos."""

    name: str
    """Name in the COLMAP model; it may contain folders."""
    path: Path
    mask_path: Path | None
    """Picture of any size, bright on the foreground."""
    lens: Lens
    """Intrinsics of the upright photo."""
    quarter_turns: int = 0
    """Clockwise quarter turns that bring the file's pixels as stored upright."""

    @classmethod
    def from_model(cls, tracked: TrackedPhoto, path: Path, mask_path: Path | None = None) -> Photo:
        """Create a photo from the model (after `upright`), with its lens at the size of the file on
        disk, so that resized photos work. Without a mask, a photo with transparent parts is its own. Raises
        UserError for an unreadable file, another aspect ratio, and a lens that no photo can have."""
        with _readable(path, tracked.name), open_picture(path) as image:
            size = _turned_size(image.size, tracked.quarter_turns)
            mask_path = mask_path or (path if see_through(image) else None)
        _check_shape(tracked.name, path, size, (tracked.width, tracked.height))
        if tracked.lens.distorts and (share := _share_seen(tracked.lens)) < _LEAST_SEEN:
            raise UserError(
                f"photo {tracked.name}: its lens bends so much that the photo fills {share:.0%} of an "
                "undistorted view: its distortion is wrong. Undistort photos with what made the model"
            )
        return cls(tracked.name, path, mask_path, tracked.lens.resized(*size), tracked.quarter_turns)

    def file_size(self) -> tuple[int, int]:
        """Read width and height of the upright file, which may be read smaller. Raises UserError for an
        unreadable file."""
        return _turned_size(stored_size(self.path, self.name)[0], self.quarter_turns)

    def at_most(self, longer_side: int) -> Photo:
        """Return the photo, to be read with at most `longer_side` pixels on its longer side."""
        shrink = longer_side / max(self.width, self.height)
        return self if shrink >= 1 else replace(self, lens=self.lens.scaled(shrink))

    def read(self, scale: float = 1.0) -> Float[Tensor, "h w 3"]:
        """Read the photo as a pinhole camera with the same fx, fy, cx, cy would take it: RGB in 0..1 at
        `scaled_size`, black where the photo does not reach. Raises UserError for an unreadable file and for
        another aspect ratio than the camera's."""
        return self.read_uint8(scale).float() / 255

    def read_uint8(self, scale: float = 1.0) -> UInt8[Tensor, "h w 3"]:
        """Read the photo like `read`, but in 0..255, for a quarter of the memory."""
        size = scaled_size(self.width, self.height, scale)
        image = self._decoded(size)
        _check_shape(self.name, self.path, image.size, (self.width, self.height))
        if self.lens.distorts:
            image = Image.fromarray(self._undistort(np.asarray(image)))
        # Pillow's bilinear filter widens when shrinking: it averages the area of each output pixel.
        return torch.from_numpy(np.array(image.resize(size, Image.Resampling.BILINEAR)))

    def read_mask(self, scale: float = 1.0) -> Bool[Tensor, "h w"] | None:
        """Read the foreground at the size of `read(scale)`: where the mask is at least half bright and
        undistortion stays inside the photo. It is None without a mask file and distortion. Raises UserError
        for an unreadable mask."""
        if self.mask_path is None and not self.lens.distorts:
            return None
        mask = np.ones((self.height, self.width), dtype=bool)
        if self.mask_path is not None:
            with _readable(self.mask_path, self.name), open_picture(self.mask_path) as image:
                gray = self._drawn_upright(mask_values(image))
            size = self.width, self.height
            _check_shape(self.name, self.mask_path, gray.size, size, "photo")
            mask = np.asarray(gray.resize(size, Image.Resampling.NEAREST)) >= 128
        if self.lens.distorts:
            mask = self._undistort(mask * np.uint8(255)) >= 128
        size = scaled_size(self.width, self.height, scale)
        return torch.from_numpy(np.array(Image.fromarray(mask).resize(size, Image.Resampling.NEAREST)))

    def read_file(self, longer_side: int) -> UInt8[Tensor, "h w 3"]:
        """Read the file upright and still distorted, shrunk to at most `longer_side` pixels, as masks are
        drawn. Raises UserError for an unreadable file."""
        shrink = longer_side / max(self.width, self.height)
        image = self._decoded(scaled_size(self.width, self.height, min(shrink, 1.0)))
        image.thumbnail((longer_side, longer_side), Image.Resampling.BILINEAR)
        return torch.from_numpy(np.array(image))

    def undistort_labels(self, labels: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
        """Undistort 32-bit labels drawn on the file (any size) like `read`, by nearest pixel; −1 outside."""
        labels = self._drawn_upright(labels)
        if not self.lens.distorts:
            return labels
        return torch.from_numpy(self._undistort(labels.numpy().astype(np.int32), nearest=True, empty=-1))

    def stamp(self, path: Path | None = None) -> list[int]:
        """Return size, modification time and inode of the photo's file (or of its mask, `path`), which change
        with the content. Raises UserError if the file is missing."""
        with _readable(path or self.path, self.name):
            status = (path or self.path).stat()
            return [status.st_size, status.st_mtime_ns, status.st_ino]

    def content_hash(self) -> str:
        """Compute a hash of the file's bytes, without camera and mask."""
        with _readable(self.path, self.name):
            return content_digest(self.path)

    def _decoded(self, at_least: tuple[int, int]) -> Image.Image:
        """Decode the file to 8-bit RGB without alpha, upright and still distorted. A large JPEG may be
        shrunk, not below `at_least`."""
        with _readable(self.path, self.name), open_picture(self.path) as file:
            if file.width * file.height > _LARGE:
                file.draft(None, _turned_size(at_least, self.quarter_turns))  # does nothing for other formats
            image = rgb_pixels(file)
        return image.transpose(_TURNS[self.quarter_turns]) if self.quarter_turns else image

    def _drawn_upright(self, drawn: Any) -> Any:
        """Turn a mask (picture) or labels (tensor) upright if they are shaped like the pixels as stored. Most
        programs draw on photos that they show upright, and these stay as they are."""
        width, height = drawn.size if isinstance(drawn, Image.Image) else tuple(drawn.shape)[::-1]
        lies = abs(math.log(width * self.height / (height * self.width)))
        if self.quarter_turns % 2 == 0 or lies <= abs(math.log(width * self.width / (height * self.height))):
            return drawn
        if isinstance(drawn, Image.Image):
            return drawn.transpose(_TURNS[self.quarter_turns])
        return drawn.rot90(-self.quarter_turns)

    def _undistort(
        self, image: UInt8[Array, "h w *c"] | Int32[Array, "h w"], nearest: bool = False, empty: int = 0
    ) -> Any:
        """Undistort a file of any size to a pinhole camera's view, which is `empty` outside the photo."""
        import cv2

        height, width = image.shape[:2]
        columns, rows, seen = _undistortion(self.lens.resized(width, height))
        blend = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        view = cv2.remap(image, columns, rows, blend, borderMode=cv2.BORDER_REPLICATE)
        view[~seen] = empty
        return view


@lru_cache(maxsize=4)  # photos of one camera share a lens
def _undistortion(lens: Lens) -> tuple[Float32[Array, "h w"], Float32[Array, "h w"], Bool[Array, "h w"]]:
    """Compute the column and row in the photo of each pixel of a pinhole's view, and if the photo has it."""
    import cv2

    # OpenCV's origin is the center of the first pixel, hence -0.5.
    pinhole = lens.matrix.numpy() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    coefficients, size = np.array(lens.distortion or (0.0,) * 4), (lens.width, lens.height)
    undistort = (cv2.fisheye if lens.fisheye else cv2).initUndistortRectifyMap
    columns, rows = undistort(pinhole, coefficients, np.eye(3), pinhole, size, cv2.CV_32FC1)
    return columns, rows, _seen(columns, rows)


@lru_cache(maxsize=256)
def _share_seen(lens: Lens) -> float:
    """Return the share of a pinhole's view that a photo through the lens has."""
    small = lens.scaled(min(1.0, 64 / max(lens.width, lens.height)))
    return float(_undistortion(small)[2].mean())


def _seen(columns: Float32[Array, "h w"], rows: Float32[Array, "h w"]) -> Bool[Array, "h w"]:
    """Return which pixels of the undistorted image sample the file, and before the distortion polynomial's
    turning point. Beyond it the map is mirrored (its determinant is negative), and shows the photo again."""
    height, width = columns.shape
    inside = (columns > -0.5) & (columns < width - 0.5) & (rows > -0.5) & (rows < height - 0.5)
    if min(height, width) < 2:  # too narrow to turn over
        return inside
    (column_dy, column_dx), (row_dy, row_dx) = np.gradient(columns), np.gradient(rows)
    return inside & (column_dx * row_dy > column_dy * row_dx)


_TURNS = {1: Image.Transpose.ROTATE_270, 2: Image.Transpose.ROTATE_180, 3: Image.Transpose.ROTATE_90}
"""Pillow's transpositions by clockwise quarter turns; Pillow itself counts counterclockwise."""


def _turned_size(size: tuple[int, int], quarters: int) -> tuple[int, int]:
    """Return width and height after quarter turns."""
    return size[::-1] if quarters % 2 else size


def stored_size(path: Path, name: str) -> tuple[tuple[int, int], int]:
    """Read width and height of a file's pixels as stored, and the quarter turns that bring them upright.
    Raises UserError for an unreadable file."""
    with _readable(path, name), open_picture(path) as image:
        return image.size, quarter_turns(image)


@contextmanager
def _readable(path: Path, name: str) -> Iterator[None]:
    """Turn Pillow's exceptions for a missing or damaged file into a UserError."""
    try:
        yield
    except FileNotFoundError as error:
        raise UserError(f"photo {name}: there is no file {path}: put it there or leave it out") from error
    except (OSError, NoPictureError) as error:
        raise UserError(
            f"photo {name}: can't read {path} ({error}): remove it, or convert it to an 8-bit JPEG or PNG"
        ) from error


def _check_shape(
    name: str, path: Path, size: tuple[int, int], whole: tuple[int, int], of: str = "COLMAP camera"
) -> None:
    """Raise UserError unless a picture has the aspect ratio of another, which cropped or turned ones lack."""
    (width, height), (w, h) = size, whole
    rounded = 0.5 / min(whole) + 0.5 / min(size)  # shorter sides of what is read small are rounded
    if abs(width * h / (height * w) - 1) > 0.01 + rounded:
        trouble = f"photo {name}: {path} has {width} × {height} pixels, but its {of} {w} × {h}"
        raise UserError(f"{trouble}, another aspect ratio: use the model's own photos, and masks of them")


_QUARTER_TURNS = {6: 1, 3: 2, 8: 3}
"""Clockwise quarter turns by EXIF's orientation. Mirrored photos (2, 4, 5, 7), which no camera could have
taken, stay as stored."""
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation of a camera's frame (x right, y down) when its photo is turned clockwise by a quarter."""


def quarter_turns(image: Image.Image) -> int:
    """Return the clockwise quarter turns that bring a file's stored pixels upright; 0 without EXIF."""
    with suppress(Exception):  # damaged EXIF, which may hold anything
        return _QUARTER_TURNS.get(image.getexif().get(ExifTags.Base.Orientation, 1), 0)
    return 0


def turned_lens(lens: Lens, quarters: int) -> Lens:
    """Return the lens of a photo after clockwise quarter turns."""
    for _ in range(quarters):
        k = lens.distortion
        if len(k) >= 4 and not lens.fisheye:  # tangential coefficients are a vector; others are radial
            k = (k[0], k[1], k[3], -k[2], *k[4:])
        width, height = lens.height, lens.width
        lens = Lens(width, height, lens.fy, lens.fx, width - lens.cy, lens.cx, k, lens.fisheye)
    return lens


def upright(tracked: TrackedPhoto, size: tuple[int, int], quarters: int) -> TrackedPhoto:
    """Turn a model's photo upright, whose file has a `size` (width, height) and `quarter_turns` as stored.
    Lens, pose and tracks are turned with the pixels. If the program that made the model had turned the photos
    already, the shape of the model's camera differs from the stored pixels', and all are kept."""
    width, height = size
    fits_stored = (tracked.width > tracked.height) == (width > height)
    lens, pixels, camera = tracked.lens, tracked.pixels, tracked.camera_from_world
    for _ in range(quarters if fits_stored or width == height or quarters % 2 == 0 else 0):
        pixels = np.column_stack([lens.height - pixels[:, 1], pixels[:, 0]])
        lens, camera = turned_lens(lens, 1), _QUARTER @ camera
    return replace(tracked, lens=lens, camera_from_world=camera, pixels=pixels, quarter_turns=quarters)
