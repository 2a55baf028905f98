"""Overview picture of a trained demo: photos, renderings, codes, and heat maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from lang3dxl_ns.common.captions import letters
from lang3dxl_ns.evaluation.scores import resize_map
from lang3dxl_ns.query.heat_maps import overlay
from lang3dxl_ns.query.match import Match

COLUMNS = 4
"""Number of prompts shown per photo."""
FOUND = (1.0, 0.0, 1.0)
"""Outline color of matches: magenta, which no heat map contains."""
CAPTION = (
    "Right columns: heat shows where the word fits; magenta outlines what it found, white the ground truth."
)
WIDTH, _GAP, _LINE = 260, 6, 24
"""Width of a column, the gap between columns, and the height of a line of text, pixels."""


@dataclass
class PictureRow:
    """A held-out photo and its renderings. Colors are 0…1."""

    name: str
    photo: Float[Array, "h w 3"]
    rendering: Float[Array, "h w 3"]
    codes: Float[Array, "h w 3"]
    matches: Mapping[str, Match]
    """Match of each prompt in the view of the photo."""
    truth: Mapping[str, Bool[Array, "mh mw"]]
    """Ground truth of each prompt. Prompts without ground truth are not shown."""


def most_telling(rows: Sequence[PictureRow], count: int) -> list[PictureRow]:
    """Choose the rows that show the most, greedily by the number of prompts not yet covered."""
    chosen: list[PictureRow] = []
    shown: set[str] = set()
    while len(chosen) < min(count, len(rows)):
        rest = [row for row in rows if not any(row is other for other in chosen)]
        best = max(rest, key=lambda row: (len(set(row.truth) - shown), len(row.truth)))
        chosen.append(best)
        shown |= set(best.truth)
    return chosen


def draw_picture(rows: Sequence[PictureRow], path: Path) -> None:
    """Write a PNG with one row per photo: photo, rendering, codes as color, and the match of each prompt. A
    match is drawn as its heat map, outlined in magenta, with the ground truth outlined in white; the last
    line of the picture says so."""
    lines = [_cells(row) for row in rows]
    height = max(_scaled_height(image) for cells in lines for _, image in cells)
    canvas = Image.new("RGB", (max(map(len, lines)) * WIDTH, len(lines) * (height + _LINE) + _LINE), "white")
    pen, font = ImageDraw.Draw(canvas), letters(_LINE * 0.6)
    for y, cells in enumerate(lines):
        for x, (title, image) in enumerate(cells):
            left, top = x * WIDTH, y * (height + _LINE)
            pen.text((left + WIDTH / 2, top + _LINE / 2), title, "black", font, anchor="mm")
            drawn = Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8))
            canvas.paste(drawn.resize((WIDTH - _GAP, _scaled_height(image))), (left, top + _LINE))
    pen.text((_GAP, canvas.height - _LINE / 2), CAPTION, "black", font, anchor="lm")
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.save(path)


def _cells(row: PictureRow) -> list[tuple[str, Float[Array, "h w 3"]]]:
    """Titles and images of one photo, the rarest prompts first."""
    rarest = sorted(row.truth, key=lambda prompt: row.truth[prompt].mean())[:COLUMNS]
    return [
        ("held-out photo", row.photo),
        ("rendering", row.rendering),
        ("3-number codes", row.codes),
        *((f"“{prompt}”", _answer(prompt, row)) for prompt in rarest),
    ]


def _scaled_height(image: Float[Array, "h w 3"]) -> int:
    return max(round(image.shape[0] * (WIDTH - _GAP) / image.shape[1]), 1)


def _answer(prompt: str, row: PictureRow) -> Float[Array, "h w 3"]:
    """Draw a prompt's heat over the gray rendering, and outline the match and the ground truth."""
    match = row.matches[prompt]
    size = (_scaled_height(row.rendering), WIDTH - _GAP)
    gray = torch.from_numpy(row.rendering).float().mean(dim=2).expand(3, -1, -1)
    picture = resize_map(gray, size).permute(1, 2, 0).clamp(0, 1)
    relevancy = resize_map(torch.from_numpy(match.relevancy).float()[None], size)[0]
    found = _resized_mask(match.mask, size)
    drawn = overlay(picture, relevancy, torch.from_numpy(found), match.threshold).numpy()
    for region, color in ((_resized_mask(row.truth[prompt], size), (1.0, 1.0, 1.0)), (found, FOUND)):
        drawn[region & ~binary_erosion(region)] = color
    return drawn


def _resized_mask(mask: Bool[Array, "h w"], size: tuple[int, int]) -> Bool[Array, "rows columns"]:
    return np.array(Image.fromarray(mask).resize(size[::-1], Image.Resampling.NEAREST))
