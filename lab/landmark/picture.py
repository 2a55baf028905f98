"""Overview picture of a trained demo: photos, renderings, codes, and heat maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from lang3dxl_ns.evaluation.scores import resize_map
from lang3dxl_ns.query.heat_maps import overlay
from lang3dxl_ns.query.match import Match

COLUMNS = 4
"""Number of prompts shown per photo."""
FOUND = (1.0, 0.0, 1.0)
"""Outline color of matches: magenta, which no heat map contains."""


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
    match is drawn as its heat map, outlined in magenta, with the ground truth outlined in white."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    columns = 3 + min(COLUMNS, max(len(row.truth) for row in rows))
    figure = Figure(figsize=(2.6 * columns, 2.15 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, row in zip(axes, rows, strict=True):
        for axis in line:
            axis.axis("off")
        pictures = {"held-out photo": row.photo, "rendering": row.rendering, "3-number codes": row.codes}
        for axis, (title, image) in zip(line, pictures.items(), strict=False):
            axis.imshow(np.clip(image, 0, 1))
            axis.set_title(title, fontsize=10)
        rarest = sorted(row.truth, key=lambda prompt: row.truth[prompt].mean())[:COLUMNS]
        for axis, prompt in zip(line[3:], rarest, strict=False):
            _draw_prompt(axis, prompt, row)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def _draw_prompt(axis, prompt: str, row: PictureRow) -> None:
    match, truth = row.matches[prompt], row.truth[prompt]
    height, width = truth.shape
    relevancy, mask = torch.from_numpy(match.relevancy), torch.from_numpy(match.mask)
    gray = torch.from_numpy(row.rendering).float().mean(dim=2).expand(3, -1, -1)
    picture = resize_map(gray, (mask.shape[0], mask.shape[1])).permute(1, 2, 0).clamp(0, 1)
    axis.imshow(overlay(picture, relevancy, mask, match.threshold).numpy(), extent=(0, width, height, 0))
    for region, color in ((truth, "white"), (match.mask, FOUND)):
        place = {"extent": (0, width, 0, height), "levels": [0.5], "linewidths": 1}
        if region.any() and not region.all():  # matplotlib warns about a contour without a line
            axis.contour(region.astype(float), colors=[color], **place)
    axis.set_xlim(0, width)
    axis.set_ylim(height, 0)
    axis.set_title(f"“{prompt}”", fontsize=10)
