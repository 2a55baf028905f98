"""Opening of untrusted pictures: only in listed formats, as stored, with a single kind of error."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped, UInt8
from numpy import ndarray as Array
from PIL import ExifTags, Image, ImageCms

from lang3dxl_ns.common.errors import DAMAGE, in_a_line, not_of_memory
from lang3dxl_ns.common.files import open_file

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "GIF", "AVIF", "HEIF")
"""Accepted formats, whatever the file's name. Some of Pillow's others start programs (EPS: Ghostscript)."""
_EXTRA = ("JXL",)
"""Formats that are accepted if a plugin of Pillow for them is installed."""
PHOTO_SUFFIXES = (
    *(".jpg", ".jpeg", ".jfif", ".jpe", ".png", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".avif"),
    *(".heic", ".heif", ".hif", ".jxl", ".mpo"),
)
RAW_SUFFIXES = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".raf", ".orf", ".rw2", ".pef"),
    *(".srw", ".3fr", ".iiq", ".x3f", ".erf", ".kdc", ".dcr", ".mrw", ".rwl", ".gpr", ".raw"),
)
"""Suffixes of camera raw files. Pillow takes some for TIFF, and reads their thumbnail."""
OTHER_SUFFIXES = (".jp2", ".j2k", ".jpx", ".exr", ".hdr", ".psd", ".tga", ".ppm", ".heics", ".insp", ".dds")
"""Suffixes of pictures in other formats, which are never read."""
_LARGEST_PROFILE = 4 << 20
"""Largest color profile that is used, bytes; those of printers have up to 3 MB."""
_BACK = {
    **{2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM},
    **{5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_90, 7: Image.Transpose.TRANSVERSE},
    8: Image.Transpose.ROTATE_270,
}
"""Transpositions that undo those of EXIF's orientations."""


class NoPictureError(Exception):
    """File that is not a complete picture in one of the accepted formats."""


@contextmanager
def open_picture(path: Path) -> Iterator[Image.Image]:
    """Open the picture in a file, with its pixels as stored, and close it afterwards. Raises OSError for
    errors of the disk, and NoPictureError for a damaged file or another format, in the enclosed block too."""
    if path.exists() and not path.is_file():
        raise NoPictureError("not a file")  # reading a pipe would never end
    if reason := unreadable(path):
        raise NoPictureError(reason)
    try:
        with _opened(path) as image:
            _check_layout(image)
            yield _as_stored(image)
    except Image.UnidentifiedImageError as error:
        raise NoPictureError(f"not a picture in one of the formats {', '.join(_formats())}") from error
    # Pillow's decoders raise these for damaged files.
    except Image.DecompressionBombError as error:
        raise NoPictureError(f"over {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels: shrink it") from error
    except (*DAMAGE, SyntaxError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # an error of the disk, not of the decoder
            raise
        not_of_memory(error)
        raise NoPictureError(in_a_line(error)) from error


def unreadable(path: Path) -> str | None:
    """Return why a picture with this suffix can't be read; None if it may be."""
    suffix = path.suffix.lower()
    if suffix in RAW_SUFFIXES:
        return f"{suffix} is a camera's raw file: develop it, and export it as JPEG"
    if suffix == ".jxl" and "JXL" not in _formats():
        return "JPEG XL needs a plugin: pip install pillow-jxl-plugin, or convert it to JPEG or PNG"
    if suffix in OTHER_SUFFIXES:
        return f"{suffix} can't be read here: convert it to JPEG or PNG"
    return None


@cache
def _formats() -> tuple[str, ...]:
    """Register the decoders, and return the names of the formats that can be read."""
    Image.init()  # otherwise Pillow knows only the most common formats
    with suppress(ImportError):
        import_module("pi_heif").register_heif_opener(thumbnails=False)
    with suppress(ImportError):
        import_module("pillow_jxl")
    return tuple(form for form in (*FORMATS, *_EXTRA) if form in Image.OPEN)


def _opened(path: Path) -> Image.Image:
    formats = _formats()
    try:
        return Image.open(path, formats=formats)
    except ValueError as error:
        if "MAX_TEXT" not in str(error):
            raise
        return Image.open(io.BytesIO(_without_text(path)), formats=["PNG"])


def _without_text(path: Path) -> bytes:
    """Return a PNG without its texts. Pillow refuses a file with more than a megabyte of them, such as the
    history that photo editors keep."""
    with open_file(path) as file:
        content = file.read()
    kept, place = [content[:8]], 8
    while place + 8 <= len(content):
        end = place + 12 + int.from_bytes(content[place : place + 4], "big")
        if content[place + 4 : place + 8] not in (b"tEXt", b"zTXt", b"iTXt"):
            kept.append(content[place:end])
        place = end
    return b"".join(kept)


def _check_layout(image: Image.Image) -> None:
    """Raise NoPictureError for a TIFF of which Pillow would read wrong colors, or a thumbnail."""
    tags = getattr(image, "tag_v2", {}) if image.format == "TIFF" else {}
    apart = tags.get(ExifTags.Base.PlanarConfiguration) == 2
    negative = tags.get(ExifTags.Base.PhotometricInterpretation) == 0
    if (apart or negative) and max(tags.get(ExifTags.Base.BitsPerSample, (1,))) > 8:
        raise NoPictureError("its 16 bits are stored by channel or as a negative: convert it to JPEG or PNG")
    if tags.get(ExifTags.Base.NewSubfileType, 0) & 1:
        raise NoPictureError("its first picture is a thumbnail: export the photo as JPEG or PNG")


def _as_stored(image: Image.Image) -> Image.Image:
    """Return a TIFF as stored. Pillow turns a TIFF while it decodes it, unlike all other formats."""
    if image.format != "TIFF":
        return image
    exif = image.getexif()
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    if orientation not in _BACK:
        return image
    details = exif.tobytes()
    image.load()
    stored = image.transpose(_BACK[orientation])
    stored.format, stored.info["exif"] = image.format, details
    return stored


def gray_values(image: Image.Image, behind: int = 0) -> Image.Image:
    """Convert an open picture to gray values 0…255, over the value `behind` where it is transparent."""
    gray = eight_bits(image).convert("L")
    if not image.has_transparency_data:
        return gray
    return Image.composite(gray, Image.new("L", gray.size, behind), opacity(image))


def opacity(image: Image.Image) -> Image.Image:
    """Return how opaque an open picture is, 0…255."""
    return image.convert("RGBA").getchannel("A")


def mask_values(image: Image.Image) -> Image.Image:
    """Convert an open mask to gray values 0…255, of which those from 128 mark the foreground.

    Gray masks are taken as they are, unless they hold only 0 and 1, as NumPy's do: 1 then marks the
    foreground. In masks with colors, as segmenters paint them, black is the background: colors of a palette
    mark the foreground, and in other pictures the brightest channel counts. Of a photo that is
    cut out, the opaque part does.
    """
    if _is_cut_out(image):
        return opacity(image)
    if not image.has_transparency_data and image.mode in ("P", "RGB"):
        colors = np.asarray(image.convert("RGB"))
        if (colors != colors[..., :1]).any():
            bright = colors.max(axis=2)
            painted = image.mode == "P"
            return Image.fromarray(np.where(bright > 0, np.uint8(255), bright) if painted else bright)
    gray = gray_values(image)
    lossless = image.format not in ("JPEG", "MPO")  # whose black may be 1 as well
    if lossless and gray.getextrema()[1] == 1:
        return gray.point(lambda value: 255 * value)
    return gray


def see_through(image: Image.Image) -> bool:
    """Return whether parts of an open picture are transparent."""
    return image.has_transparency_data and bool(np.asarray(opacity(image)).min() < 128)


def _is_cut_out(image: Image.Image) -> bool:
    """Return whether parts are transparent, and the others a photo or dark: no mask in black and white."""
    if not see_through(image):
        return False
    shown = np.asarray(image.convert("L"))[np.asarray(opacity(image)) >= 128]
    return shown.size > 0 and bool(shown.max() < 128 or np.mean((shown > 16) & (shown < 239)) > 0.1)


def eight_bits(image: Image.Image) -> Image.Image:
    """Scale gray values of 16 bits, which `convert` would clip at 255, to 8 bits; others stay as they are.
    Raises ValueError for floating-point pixels."""
    if image.mode == "F":
        raise ValueError("its pixels are floating-point numbers of unknown range")
    if not image.mode.startswith("I"):
        return image
    values = np.asarray(image).clip(0, 65535)
    return Image.fromarray((values / (257 if values.max() > 255 else 1)).round().astype(np.uint8))


def rgb_pixels(image: Image.Image) -> Image.Image:
    """Convert an open picture to 8-bit RGB, in sRGB where it brings a color profile, as photos of phones do.
    A profile that is damaged, or fits other pixels, doesn't count."""
    pixels = eight_bits(image)
    profile = image.info.get("icc_profile")
    if not profile or len(profile) > _LARGEST_PROFILE:
        return pixels.convert("RGB")
    with suppress(*DAMAGE, ImageCms.PyCMSError):
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if "sRGB" not in ImageCms.getProfileDescription(source):
            pixels = pixels if pixels.mode in ("L", "CMYK", "LAB") else pixels.convert("RGB")
            converted = ImageCms.profileToProfile(
                pixels, source, ImageCms.createProfile("sRGB"), outputMode="RGB"
            )
            assert converted is not None
            return converted
    return pixels.convert("RGB")


def color_bytes(colors: Shaped[Array, "n 3"]) -> UInt8[Array, "n 3"]:
    """Convert stored colors to bytes: floating-point numbers up to 1 are fractions, numbers up to 255 are
    bytes, and larger ones have 16 bits."""
    if colors.dtype == np.uint8 or not colors.size:
        return colors.astype(np.uint8)
    values: Any = np.nan_to_num(colors.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    most = values.max()
    if most <= 1 and colors.dtype.kind == "f":
        values = values * 255
    elif most > 255:
        values = values / 257
    return values.round().clip(0, 255).astype(np.uint8)
