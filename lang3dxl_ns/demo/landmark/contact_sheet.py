"""Contact sheet: six photos of a collection with their ground truth, in one picture."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.demo.landmark.labels import CATEGORIES

COLORS = {
    "towers": (255, 150, 20),
    "minarets": (60, 200, 70),
    "spires": (190, 50, 230),
    "domes": (30, 200, 200),
    "portals": (225, 35, 45),
    "windows": (40, 80, 255),
}
"""In painting order: windows over towers."""
PHOTOS = 6
CELL = (320, 240)
GAP, LEGEND = 6, 30


def contact_sheet(scene: Path) -> Image.Image:
    """The six photos that show the most, each with its categories painted over it, above a legend.

    Reads only images/ and ground_truth/<category>/NNNN-gt.jpg. Raises UserError without those.
    """
    photos = _most_telling(scene / "ground_truth")
    if not photos:
        raise UserError(f"{scene} has no ground_truth/<category>/NNNN-gt.jpg: nothing to lay over its photos")
    (width, height), rows = CELL, math.ceil(len(photos) / 2)
    sheet = Image.new("RGB", (4 * width + 5 * GAP, rows * (height + GAP) + GAP + LEGEND), "white")
    for i, name in enumerate(photos):
        photo = Image.open(scene / "images" / f"{name}.jpg").convert("RGB")
        x, y = GAP + (i % 2) * 2 * (width + GAP), GAP + (i // 2) * (height + GAP)
        sheet.paste(_fitted(photo), (x, y))
        sheet.paste(_fitted(_painted(photo, scene / "ground_truth", name)), (x + width + GAP, y))
    _draw_legend(ImageDraw.Draw(sheet), rows * (height + GAP) + GAP)
    return sheet


def _most_telling(truth: Path) -> list[str]:
    """Names of the photos with the most categories; ties go to the rarer ones."""
    photos = {c: {path.name[:4] for path in (truth / c).glob("*-gt.jpg")} for c in CATEGORIES}
    score: dict[str, float] = {}
    for names in photos.values():
        for name in names:
            score[name] = score.get(name, 0) + 1 + 1 / len(names)
    return sorted(score, key=lambda name: (-score[name], name))[:PHOTOS]


def _painted(photo: Image.Image, truth: Path, name: str) -> Image.Image:
    pixels = np.asarray(photo, dtype=np.float32)
    pixels = 0.55 * pixels.mean(axis=2, keepdims=True) + 0.45 * 255 * np.ones(3)  # faded: colors stand out
    for category, color in COLORS.items():
        path = truth / category / f"{name}-gt.jpg"
        if path.exists():
            mask = np.asarray(Image.open(path).convert("L")) < 128
            pixels[mask] = 0.3 * pixels[mask] + 0.7 * np.array(color)
    return Image.fromarray(pixels.astype(np.uint8))


def _fitted(photo: Image.Image) -> Image.Image:
    """The photo fitted into a cell, on gray."""
    cell = Image.new("RGB", CELL, (235, 235, 235))
    scale = min(CELL[0] / photo.width, CELL[1] / photo.height)
    small = photo.resize((round(photo.width * scale), round(photo.height * scale)), Image.Resampling.LANCZOS)
    cell.paste(small, ((CELL[0] - small.width) // 2, (CELL[1] - small.height) // 2))
    return cell


def _draw_legend(draw: ImageDraw.ImageDraw, y: int) -> None:
    font = ImageFont.load_default(size=16)
    x = GAP
    for category in CATEGORIES:
        draw.rectangle((x, y + 5, x + 16, y + 21), fill=COLORS[category])
        draw.text((x + 22, y + 3), category, fill="black", font=font)
        x += 130
