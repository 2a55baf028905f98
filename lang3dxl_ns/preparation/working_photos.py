"""Photos at working size: decoded, turned upright, undistorted and shrunk once, stored beside the targets."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image, PngImagePlugin
from torch import Tensor

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.pictures import NoPictureError, open_picture
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.scene.camera import scaled_size
from lang3dxl_ns.scene.photo import Photo

PHOTOS, PHOTO_MASKS = "photos", "photo_masks"
"""Kinds of entries in the store."""
_QUALITY = 95
"""JPEG quality: 46 dB, a tenth of the bytes, 12 ms to decode 1,600 × 1,200 pixels on one core."""
_SMALL = 1_000_000
"""Largest file, in pixels, that is decoded as fast as a copy."""
_RULE = 3
"""Version of the copies, increased when photos or masks are decoded otherwise, to make older ones again."""


class WorkingPhotos:
    """Reader of photos like `Photo.read_uint8` and `Photo.read_mask`, from copies that it keeps in a store.

    A copy is made when a photo is first read, if its file is large and has to be shrunk, turned or
    undistorted. It is made again if file or lens have changed. Threads and processes may share a store.
    """

    def __init__(self, store: FeatureStore) -> None:
        self._store = store
        self._told = False

    def read(self, photo: Photo, scale: float = 1.0) -> UInt8[Tensor, "h w 3"]:
        """Read a photo like `Photo.read_uint8`. It raises UserError likewise, even for a file with a copy."""
        path = self._store.path(PHOTOS, photo.name).with_suffix(".jpg")
        made_with = _made_with(photo, photo.path)
        image = kept_picture(path, made_with, "RGB")
        if image is None:
            if not _is_slow(photo, photo.path):
                return photo.read_uint8(scale)
            image, content = Image.fromarray(photo.read_uint8().numpy()), io.BytesIO()
            image.save(content, "JPEG", quality=_QUALITY, comment=made_with)
            self._keep(path, content.getvalue())
        return _resized(image, photo, scale, Image.Resampling.BILINEAR)

    def mask(self, photo: Photo, scale: float = 1.0) -> Bool[Tensor, "h w"] | None:
        """Read a mask like `Photo.read_mask`, and raise UserError likewise."""
        source = photo.mask_path or photo.path
        if (photo.mask_path is None and not photo.lens.distorts) or not _is_slow(photo, source):
            return photo.read_mask(scale)
        path = self._store.path(PHOTO_MASKS, photo.name).with_suffix(".png")
        made_with = _made_with(photo, source)
        image = kept_picture(path, made_with, "1")
        if image is None:
            mask = photo.read_mask()
            assert mask is not None
            image = Image.fromarray(mask.numpy())
            self._keep(path, mask_png(mask, made_with))
        return _resized(image, photo, scale, Image.Resampling.NEAREST)

    def _keep(self, path: Path, content: bytes) -> None:
        """Write a copy. Without space or permission it is not written, and the photo is decoded each time; a
        message tells so once."""
        try:
            self._store.write_bytes(path, content, path.name)
        except UserError as error:
            if not self._told:
                self._told = True
                say(f"Large photos are decoded anew in every round, which is slow: {error}")


def mask_png(mask: Bool[Tensor, "h w"], made_with: str) -> bytes:
    """Encode a mask as a black-and-white PNG that contains the settings that made it."""
    text, content = PngImagePlugin.PngInfo(), io.BytesIO()
    text.add_text("settings", made_with)
    Image.fromarray(mask.numpy()).save(content, "PNG", pnginfo=text)
    return content.getvalue()


def kept_picture(path: Path, made_with: str, mode: str | None = None) -> Image.Image | None:
    """Read a `mask_png`, or a JPEG with such a comment, if it is complete and was made with these settings;
    else return None. `mode` is the mode of the pixels; None checks the file and decodes nothing."""
    if not path.is_file():
        return None
    try:
        with open_picture(path) as copy:
            written = copy.info.get("settings", copy.info.get("comment"))
            written = written.decode(errors="replace") if isinstance(written, bytes) else written
            if written != made_with:
                return None
            if mode is None:
                copy.verify()  # reads all of it
                return copy
            copy.load()
            return copy if copy.mode == mode else copy.convert(mode)
    except (OSError, NoPictureError):
        return None


def _made_with(photo: Photo, source: Path) -> str:
    """Describe everything that determines a copy, as JSON. Raises UserError if the source is missing."""
    size = [photo.width, photo.height, photo.quarter_turns]
    made_with = {"file": photo.stamp(source), "size": size, "undistorted": photo.lens.undistortion}
    return json.dumps({**made_with, "rule": _RULE})


def _is_slow(photo: Photo, source: Path) -> bool:
    """Return whether reading a file takes longer than reading a copy at the photo's size."""
    try:
        with open_picture(source) as image:
            pixels = math.prod(image.size)
    except (OSError, NoPictureError):
        return False  # reading it reports the reason
    shrinks = pixels > 1.2 * photo.width * photo.height
    return pixels > _SMALL and (shrinks or photo.lens.distorts or photo.quarter_turns > 0)


def _resized(image: Image.Image, photo: Photo, scale: float, method: Image.Resampling) -> Tensor:
    size = scaled_size(photo.width, photo.height, scale)
    return torch.from_numpy(np.array(image if image.size == size else image.resize(size, method)))
