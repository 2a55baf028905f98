"""Ground-truth annotation of one category in one photo: a mask, and boxes if the labels have some."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool, Float
from numpy import ndarray as Array
from PIL import Image

from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.pictures import NoPictureError, eight_bits, open_picture

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Suffixes of pictures, lower case."""


@dataclass(frozen=True)
class Truth:
    """Ground truth of a category in a photo, at the size of a map."""

    mask: Bool[Array, "h w"]
    """True on the object."""
    boxes: Float[Array, "n 4"] | None = None
    """Left, top, right and bottom in pixels of the mask, edges included; None if the labels have no boxes."""


def read_gray(path: Path, what: str = "ground truth", behind: int = 0) -> Image.Image:
    """Read a picture as gray values 0…255, over the value `behind` where it is transparent. Raises UserError
    if it cannot be read."""
    problem, damage = f"{what} {path} can't be read", (OSError, NoPictureError)
    with readable(problem, "replace or remove it", damage), open_picture(path) as image:
        gray = eight_bits(image).convert("L")
        if image.has_transparency_data:
            alpha = image.convert("RGBA").getchannel("A")
            gray = Image.composite(gray, Image.new("L", gray.size, behind), alpha)
        return gray


def check_shape(path: Path, mine: tuple[int, int], other: tuple[int, int]) -> None:
    """Check that two sizes (height, width) differ by a factor, within a rounded pixel, or raise UserError."""
    (height, width), (other_height, other_width) = mine, other
    difference = abs(width * other_height - height * other_width)
    if difference > max(0.01 * height * other_width, height, width):
        raise UserError(
            f"{path} has {width} × {height} pixels, but is compared with a picture of {other_width} × "
            f"{other_height}, another aspect ratio: it belongs to another photo, or was cropped or rotated"
        )
