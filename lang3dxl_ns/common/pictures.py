"""Opening of untrusted pictures: only in listed formats, with a single kind of error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

from lang3dxl_ns.common.errors import DAMAGE, not_of_memory

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "GIF", "AVIF")
"""Accepted formats, whatever the file's name. Some of Pillow's others start programs (EPS: Ghostscript)."""


class NoPictureError(Exception):
    """File that is not a complete picture in one of the accepted formats."""


@contextmanager
def open_picture(path: Path) -> Iterator[Image.Image]:
    """Open the picture in a file, and close it afterwards. Raises OSError for errors of the disk, and
    NoPictureError for a damaged file or another format, in the enclosed block too."""
    if path.exists() and not path.is_file():
        raise NoPictureError("not a file")  # reading a pipe would never end
    Image.init()  # otherwise Pillow knows only the most common formats
    try:
        with Image.open(path, formats=[form for form in FORMATS if form in Image.OPEN]) as image:
            yield image
    except Image.UnidentifiedImageError as error:
        raise NoPictureError(f"not a picture in one of the formats {', '.join(FORMATS)}") from error
    # Pillow's decoders raise these for damaged files.
    except (*DAMAGE, SyntaxError, Image.DecompressionBombError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # an error of the disk, not of the decoder
            raise
        not_of_memory(error)
        raise NoPictureError(str(error) or type(error).__name__) from error


def gray_values(image: Image.Image, behind: int = 0) -> Image.Image:
    """Convert an open picture to gray values 0…255, over the value `behind` where it is transparent."""
    gray = eight_bits(image).convert("L")
    if not image.has_transparency_data:
        return gray
    return Image.composite(gray, Image.new("L", gray.size, behind), image.convert("RGBA").getchannel("A"))


def eight_bits(image: Image.Image) -> Image.Image:
    """Scale gray values of 16 bits, which `convert` would clip at 255, to 8 bits; others stay as they are.
    Raises ValueError for floating-point pixels."""
    if image.mode == "F":
        raise ValueError("its pixels are floating-point numbers of unknown range")
    if not image.mode.startswith("I"):
        return image
    values = np.asarray(image).clip(0, 65535)
    return Image.fromarray((values / (257 if values.max() > 255 else 1)).round().astype(np.uint8))
