"""Captions in pictures: a font with the letters of European languages, and lines of a width."""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from PIL import ImageFont

Font = ImageFont.ImageFont | ImageFont.FreeTypeFont
_FONTS = ("DejaVuSans.ttf", "NotoSans-Regular.ttf", "LiberationSans-Regular.ttf", "Arial.ttf")
"""Fonts that Linux, macOS or Windows have. Pillow's own has boxes for all letters but ASCII's."""


@lru_cache
def letters(size: float) -> Font:
    """Load a font of this machine, or else Pillow's own, with letters of this height in pixels."""
    found = find_spec("matplotlib")  # which brings one, on machines without fonts
    brought = Path((found and found.origin) or "").parent / "mpl-data/fonts/ttf" / _FONTS[0]
    for font in (*_FONTS, str(brought)):
        with suppress(OSError):
            return ImageFont.truetype(font, size)
    return ImageFont.load_default(size)


def lines(text: str, font: Font, width: float) -> str:
    """Break a text into lines of at most this width in pixels: between words, or within a longer one."""
    found = [""]
    for word in text.split():
        longer = f"{found[-1]} {word}".lstrip()
        if font.getlength(longer) <= width:
            found[-1] = longer
            continue
        found.append("")
        for letter in word:
            if found[-1] and font.getlength(found[-1] + letter) > width:
                found.append("")
            found[-1] += letter
    return "\n".join(filter(None, found))
