"""Where views show things: the pixels of each, and numbered outlines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
import torch
from jaxtyping import Int, UInt8
from numpy import ndarray as Array
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull

from lang3dxl_ns.query.heat_maps import PROMPT_COLORS
from lang3dxl_ns.query.match import as_bytes
from lang3dxl_ns.rendering import Rendering, Splats, composite
from lang3dxl_ns.scene.camera import Camera, projected
from lang3dxl_ns.things.find import Things
from lang3dxl_ns.things.thing import Thing

LIGHT = 1 / 3
"""Share of a pixel's light that comes from a thing where the pixel shows it. Masks in the demo's photos are
as large as the true ones then, and 94 % of the views of things have one (`lang3dxl benchmark things`)."""
PLACES = 8
"""Number of a thing's Gaussians, at most, at whose places a view is looked up."""
SHOWN = 0.25
"""Share of these places that must show the thing, or it counts as hidden: 14 % of what the demo's photos show
does, and 2 % of what counts as shown is hidden."""
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))


def numbered(answers: Sequence[Things]) -> list[tuple[int, int, Thing]]:
    """List the things of several words, each once, with the index of the first word that finds it and its
    number there, from 1."""
    first = dict[int, tuple[int, int, Thing]]()
    for which, one in enumerate(answers):
        for number, thing in enumerate(one.things, start=1):
            first.setdefault(thing.id, (which, number, thing))
    return list(first.values())


@torch.no_grad()
def held(splats: Splats, camera: Camera, words: Sequence[Sequence[Thing]]) -> list[Int[Array, "h w"]]:
    """Tell for each word and pixel of a view the number, from 1, of the thing that it shows; 0 for none. The
    things of one word share no Gaussians."""
    channels = []
    for things in words:
        numbers = np.zeros(len(splats), int)
        for number, thing in enumerate(things, start=1):
            numbers[thing.rows] = number
        # A pixel's number has the bits that most of the light from things has: few channels for many things.
        bits = np.arange(len(things).bit_length())
        channels.append(np.column_stack([numbers > 0, numbers[:, None] >> bits & 1]))
    drawn = composite(splats, camera, torch.from_numpy(np.hstack(channels)).to(splats.means)).cpu().numpy()
    maps = []
    for part in np.split(drawn, np.cumsum([one.shape[1] for one in channels])[:-1], axis=2):
        light, ones = part[..., 0], part[..., 1:]
        found = ((ones > light[..., None] / 2) << np.arange(ones.shape[2])).sum(2)
        maps.append(np.where(light > LIGHT, found, 0))
    return maps


def shown(
    splats: Splats, camera: Camera, things: Sequence[Thing]
) -> Iterator[tuple[int, Thing, tuple[int, int]]]:
    """Yield the things of one word that a view shows, each with its number and the middle of its pixels
    (column and row): those that it shows at a quarter of the places of some of their Gaussians."""
    (pixels,) = held(splats, camera, [things])
    for number, thing in enumerate(things, start=1):
        rows = np.sort(thing.rows)[:: 1 + (len(thing.rows) - 1) // PLACES]
        x, y, depth = projected(camera, splats.means[rows]).cpu().numpy().T
        inside = (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        own = pixels[y[inside].astype(int), x[inside].astype(int)] == number
        if own.any() and own.mean() >= SHOWN:
            row, column = (int(np.median(side)) for side in (pixels == number).nonzero())
            yield number, thing, (column, row)


def outlined(splats: Splats, answers: Sequence[Things], rendering: Rendering) -> UInt8[Array, "h w 3"]:
    """Draw the boxes of the things that a rendering of the splats shows, each once, in its first word's color
    and with its number there."""
    picture, camera = Image.fromarray(as_bytes(rendering.rgb)), rendering.camera
    pen = ImageDraw.Draw(picture)
    first = {thing.id: which for which, _, thing in numbered(answers)}
    for which, one in enumerate(answers):
        color = PROMPT_COLORS[which % len(PROMPT_COLORS)]
        for number, thing, middle in shown(splats, camera, one.things):
            corners = torch.from_numpy(thing.center + (_CORNERS * thing.size) @ thing.axes)
            seen = projected(camera, corners).cpu().numpy()
            if first[thing.id] != which or seen[:, 2].min() < 1e-2 * thing.size.max():
                continue  # under an earlier word, or around the camera
            around = seen[ConvexHull(seen[:, :2], qhull_options="QJ").vertices, :2]
            pen.polygon(around.ravel().tolist(), outline=color, width=2)
            pen.text(middle, str(number), color, anchor="mm", stroke_width=1, stroke_fill="white")
    return np.asarray(picture)
