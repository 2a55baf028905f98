"""True things of a landmark: every window, portal, dome, tower, spire, minaret, and which photos show it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from lab.landmark.labels import ELEMENTS, PARTS
from lab.landmark.landmark import Landmark
from lab.landmark.openings import Openings
from lab.landmark.raycast import Camera, cast
from lab.landmark.shapes import Shape
from lang3dxl_ns.common.files import read_json

WORDS = {"window": "windows", "portal": "portals", "dome": "domes", "tower": "towers"}
WORDS |= {"spire": "spires", "minaret": "minarets"}
"""Benchmark category of each element or part."""
CLEAR = 173
"""Pixels that a photo must show of a thing: what an annotator would outline of 480 × 360, see labels."""


@dataclass(frozen=True, eq=False)
class TrueThing:
    """One thing of a landmark."""

    word: str
    """Benchmark category."""
    center: Float[Array, "3"]
    """Center of its box, meters (after `placed`: world units)."""
    axes: Float[Array, "3 3"]
    """Directions of the box's edges, one a row."""
    size: Float[Array, "3"]
    """Lengths of the edges along the axes."""
    pixels: int = 0
    """Pixels of it in the training photo that shows it second best: one photo tells no place in 3D."""

    @property
    def seen(self) -> bool:
        """Whether the training photos show it clearly enough to be expected."""
        return self.pixels >= CLEAR


def true_things(landmark: Landmark) -> tuple[list[TrueThing], list[Array]]:
    """List a landmark's things, in meters, and for each shape the numbers of the things that it holds: those
    of its tiles, row by row from the lower left as one faces an opening, or one; empty for other shapes."""
    found: list[TrueThing] = []
    numbers: list[Array] = [np.zeros(0, int) for _ in landmark.shapes]
    for i, shape in enumerate(landmark.shapes):
        word = WORDS.get(ELEMENTS[shape.element])
        if isinstance(shape, Openings) and word:
            tiles = [_opening(shape, word, *tile) for tile in np.ndindex(shape.rows, shape.columns)]
            numbers[i] = np.arange(len(found), len(found) + len(tiles))
            found += tiles
    for part, shapes in _solids(landmark):
        for i in shapes:
            numbers[i] = np.array([len(found)])
        found.append(_solid([landmark.shapes[i] for i in shapes], WORDS[part]))
    return found, numbers


def _solids(landmark: Landmark) -> Iterator[tuple[str, list[int]]]:
    """Yield part and shapes of every thing. A dome that was built of one bare shape is a thing too."""
    free = {
        i for i, s in enumerate(landmark.shapes) if not isinstance(s, Openings) and PARTS[s.part] in WORDS
    }
    for part, shapes in landmark.things:
        own = [i for i in shapes if i in free and PARTS[landmark.shapes[i].part] == part]
        free -= set(own)
        if own:
            yield part, own
    yield from ((PARTS[landmark.shapes[i].part], [i]) for i in sorted(free))


def _opening(shape: Openings, word: str, row: int, column: int) -> TrueThing:
    wide, tall = shape.field[0] / shape.columns, shape.field[1] / shape.rows
    sill = 0.0 if shape.rows == 1 else (tall - shape.height) / 2
    local = (
        -shape.depth / 2,
        (column + 0.5) * wide - shape.field[0] / 2,
        row * tall + sill + shape.height / 2,
    )
    center = np.array(shape.to_world(local)) + shape.position
    return TrueThing(word, center, _axes(shape.yaw), np.array([shape.depth, shape.width, shape.height]))


def _solid(shapes: list[Shape], word: str) -> TrueThing:
    axes = _axes(shapes[0].yaw)
    corners = np.concatenate([shape.corners for shape in shapes]) @ axes.T
    low, high = corners.min(0), corners.max(0)
    return TrueThing(word, (low + high) / 2 @ axes, axes, high - low)


def _axes(yaw: float) -> Float[Array, "3 3"]:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def pixels(
    landmark: Landmark, numbers: list[Array], camera: Camera, size: tuple[int, int]
) -> Int[Array, "h w"]:
    """Compute the number of the thing that each pixel shows, -1 for none, ignoring passers-by."""
    width, height = size
    depth, index = cast(landmark.shapes, camera, width, height)
    origin, direction = camera.rays(width, height)
    things = np.full((height, width), -1)
    for i in np.unique(index[index >= 0]).tolist():
        shape, where = landmark.shapes[i], index == i
        if isinstance(shape, Openings) and len(numbers[i]):
            t = depth[where]
            at = [
                o + t * np.broadcast_to(d, index.shape)[where] for o, d in zip(origin, direction, strict=True)
            ]
            _, y, z = shape.point_to_local((at[0], at[1], at[2]))
            column = ((y / shape.field[0] + 0.5) * shape.columns).astype(int).clip(0, shape.columns - 1)
            row = (z / shape.field[1] * shape.rows).astype(int).clip(0, shape.rows - 1)
            inside = shape._inside(*shape._tile(y, z)) > 0
            things[where] = np.where(inside, numbers[i][row * shape.columns + column], -1)
        elif len(numbers[i]):
            things[where] = numbers[i][0]
    return things


def photos_of(about: dict[str, Any]) -> Iterator[tuple[str, Camera, tuple[int, int]]]:
    """Yield name, camera and size of each training photo of the demo scene that scene.json tells `about`."""
    from lab.landmark.scene_writer import photo_view

    landmark = Landmark.from_seed(about["seed"], about["family"])
    for number in range(1, about["photos"] + 1):
        name = f"{number:04d}.jpg"
        if name not in about["held_out"]:
            view, *size = photo_view(landmark, about["seed"], number, about["wild"], (480, 360))
            yield name, view.camera, (size[0], size[1])


def seen_things(data: Path, coarse: int = 2) -> list[TrueThing]:
    """List the true things of a demo scene in COLMAP's frame, with which ones its training photos show.

    Args:
        data: folder of a demo scene, which holds scene.json.
        coarse: photos are cast at 1/coarse of their size.
    """
    about = read_json(data / "scene.json")
    landmark = Landmark.from_seed(about["seed"], about["family"])
    things, numbers = true_things(landmark)
    shown = np.zeros((len(things), 2), int)
    for _, camera, (width, height) in photos_of(about):
        flat = pixels(landmark, numbers, camera, (width // coarse, height // coarse)).ravel()
        counts = np.bincount(flat[flat >= 0], minlength=len(things)) * coarse**2
        shown = np.sort(np.column_stack([shown, counts]), axis=1)[:, 1:]
    frame = about["colmap_from_meters"]
    rotation = np.array(frame["rotation"])
    return [placed(t, frame["scale"], rotation, np.array(frame["translation"]), int(n))
            for t, n in zip(things, shown[:, 0], strict=True)]  # fmt: skip


def placed(
    thing: TrueThing, scale: float, rotation: Float[Array, "3 3"], shift: Float[Array, "3"], pixels: int
) -> TrueThing:
    """Return a thing in another frame: scale · rotation · x + shift."""
    center = scale * rotation @ thing.center + shift
    return TrueThing(thing.word, center, thing.axes @ rotation.T, thing.size * scale, pixels)
