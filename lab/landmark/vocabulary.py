"""Building parts of landmarks: towers, domes, minarets, rows of windows, portals, columns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lab.landmark.labels import ELEMENT, PART
from lab.landmark.materials import COVERING, MASONRY, make_material
from lab.landmark.openings import Openings
from lab.landmark.shape_list import Point, ShapeList, is_thing

FRONT, LEFT, BACK, RIGHT = 0.0, math.pi / 2, math.pi, -math.pi / 2
"""Facings of walls, as angles from +x, which the façade faces."""


@dataclass
class Builder(ShapeList):
    """Builder of one landmark, which chooses the style shared by all its parts."""

    facade_height: float = 30.0
    """Height of the façade, meters. Windows are 1/60 to 1/8 of it high."""

    def __post_init__(self) -> None:
        self._choose_materials()
        self.window_outline = self.pick("round", "pointed", "round", "rectangle", "segment")
        self.glazing = self.pick("mullion", "grid", "lattice", "tracery", "plain", "mullion")
        self.portal_outline = self.pick("round", "pointed")
        self.doors = self.pick("leaves", "panels", "tympanum", "leaves", "open")
        self.dome_rise = self.between(0.75, 1.2)
        self.onion = self.chance(0.3)
        self.lantern = self.chance(0.5)
        self.round_spires = self.chance(0.4)

    def _choose_materials(self) -> None:
        """Choose materials from the same two palettes, so that color does not reveal a category."""
        rng = self.rng

        def palette(names: tuple[str, ...]) -> list[int]:
            chosen = rng.choice(names, 3, replace=False)
            return [self.add_material(make_material(name, rng)) for name in chosen]

        masonry, covering = palette(MASONRY), palette(COVERING)
        wall = masonry[0]
        for role, share in (("trim", 0.25), ("tower", 0.7), ("minaret", 0.5), ("column", 0.3), ("drum", 0.7)):
            self.role[role] = wall if self.chance(share) else int(rng.choice(masonry[1:]))
        self.role |= {"wall": wall, "roof": covering[0]}
        for role in ("dome", "spire", "cap"):
            self.role[role] = int(rng.choice(covering if self.chance(0.75) else masonry))
        glass = "stained glass" if self.chance(0.25) else "glass"
        self.role["glass"] = self.add_material(make_material(glass, rng))
        self.role["door"] = self.add_material(make_material(self.pick("wood", "wood", "bronze"), rng))
        self.role["shadow"] = self.add_material(make_material("shadow", rng))


def ahead(point: Point, facing: float, distance: float, aside: float = 0.0) -> Point:
    """Return a point `distance` in front of a wall that faces `facing`, and `aside` to its left."""
    c, s = math.cos(facing), math.sin(facing)
    return point[0] + c * distance - s * aside, point[1] + s * distance + c * aside, point[2]


def above(point: Point, height: float) -> Point:
    """Return a point `height` meters above another."""
    return point[0], point[1], point[2] + height


def window_row(
    b: Builder,
    part: str,
    foot: Point,
    facing: float,
    width: float,
    height: float,
    columns: int | None = None,
    rows: int = 1,
    filling: str | None = None,
) -> None:
    """Add windows on a field of wall whose lower edge is centered at `foot`. Without `columns`, their number
    follows from the width. Windows that cannot be between 1/60 and 1/8 of the façade's height are left
    out."""
    smallest, largest = b.facade_height / 60, b.facade_height / 8
    tall = float(np.clip(b.between(0.6, 0.9) * height / rows, smallest, largest))
    wide = tall * b.between(0.32, 0.55)
    if columns is None:
        columns = max(1, round(width / (wide * b.between(1.7, 2.6))))
    wide = min(wide, 0.8 * width / columns)
    if tall > height / rows or min(wide, tall) < smallest * 0.3:
        return
    style, tiles = (b.window_outline, filling or b.glazing), (columns, rows)
    _opening(b, part, "window", foot, facing, (width, height), (wide, tall), style, tiles)


def rose_window(b: Builder, part: str, foot: Point, facing: float, diameter: float) -> None:
    diameter = min(diameter, b.facade_height / 8)
    field_, size = (diameter * 1.5, diameter * 1.3), (diameter, diameter)
    _opening(b, part, "window", foot, facing, field_, size, ("circle", "rose"))


def portal(b: Builder, part: str, foot: Point, facing: float, width: float, height: float) -> None:
    """Add a door with a stepped reveal, sometimes behind steps."""
    orders = int(b.rng.integers(1, 5))
    step = 0.26 * width / 2 / orders
    field_, style = (width * 1.5, height * 1.12), (b.portal_outline, b.doors)
    _opening(b, part, "portal", foot, facing, field_, (width, height), style, orders=orders, step=step)
    for i in range(int(b.rng.integers(0, 4))):
        depth = 1.6 - 0.4 * i
        slab = (depth, width * 1.9 - 0.5 * i, 0.16 * (i + 1))
        b.box("ground", "trim", ahead(foot, facing, depth / 2), slab, facing)


def niche_row(b: Builder, foot: Point, facing: float, width: float, height: float, columns: int) -> None:
    """Add blind arches, which look like windows but are walled up."""
    tall = min(0.86 * height, b.facade_height / 8)
    wide = min(tall * 0.5, 0.7 * width / columns)
    style = ("round", "plain")
    _opening(b, "clutter", "none", foot, facing, (width, height), (wide, tall), style, (columns, 1))


def _opening(b, part, element, foot, facing, field_, size, style, tiles=(1, 1), orders=1, step=None) -> None:
    outline, filling = style
    fillings = {"portal": "shadow" if filling == "open" else "door", "window": "glass", "none": "wall"}
    material = fillings[element] if filling != "louvre" else "shadow"
    depth = 0.35 + 0.3 * orders if element == "portal" else min(0.28 * size[0], 0.7)
    surround = min(0.14 * size[0], 0.4) if element != "none" else 0.0
    opening = Openings(
        PART[part], b.role[material], ahead(foot, facing, 0.04), facing, ELEMENT[element],
        trim_material=b.role["trim"], field=field_, columns=tiles[0], rows=tiles[1], width=size[0],
        height=size[1], outline=outline, filling=filling, depth=depth, orders=orders,
        step=0.05 * size[0] if step is None else step, surround=surround,
    )  # fmt: skip
    b.shapes.append(opening)


@is_thing
def dome(
    b: Builder, foot: Point, radius: float, drum: float, windows: bool = True, onion: bool | None = None
) -> None:
    """Add a dome on a drum of the given height, with windows around the drum."""
    if drum > 0:
        b.cone("wall", "drum", foot, radius * 1.02, radius * 1.02, drum)
        b.cone("wall", "trim", above(foot, drum * 0.92), radius * 1.08, radius * 1.08, drum * 0.1)
    if windows and drum > 1:
        sides = int(b.rng.choice([8, 12, 16]))
        for i in range(sides):
            facing = 2 * math.pi * i / sides
            # The field is flat and the drum round, so the field is placed in front of the curve's middle.
            side = 2 * math.pi * radius / sides
            place = ahead(above(foot, drum * 0.12), facing, radius * 1.02)
            window_row(b, "wall", place, facing, side * 0.6, drum * 0.74, columns=1)
    x, y, z = above(foot, drum)
    if b.onion if onion is None else onion:
        top = z + _onion(b, (x, y, z), radius)
    else:
        b.ellipsoid("dome", "dome", (x, y, z), (radius, radius, radius * b.dome_rise), cut=0.0)
        top = z + radius * b.dome_rise
        if b.lantern and radius > 3:
            b.cone("dome", "trim", (x, y, top - 0.06 * radius), radius * 0.16, radius * 0.16, radius * 0.34)
            ball = (radius * 0.19, radius * 0.19, radius * 0.2)
            b.ellipsoid("dome", "dome", (x, y, top + 0.28 * radius), ball, cut=0.0)
            top += 0.46 * radius
    if radius > 1:
        b.cone("dome", "trim", (x, y, top - 0.05 * radius), radius * 0.04, radius * 0.015, radius * 0.4)
        b.ellipsoid("dome", "trim", (x, y, top + 0.1 * radius), (radius * 0.06,) * 3)


def _onion(b: Builder, foot: Point, radius: float) -> float:
    """Add a bulb continued smoothly by a cone, and return its height."""
    x, y, z = foot
    bulge, tall, angle = radius * 1.15, radius * 1.0, math.radians(48)
    lower = tall * math.sqrt(1 - (radius / bulge) ** 2)  # where the bulb is as wide as the drum
    middle, join = z + lower, tall * math.sin(angle)
    b.ellipsoid("dome", "dome", (x, y, middle), (bulge, bulge, tall), cut=-lower, end=join)
    height = tall / math.sin(angle) - join
    b.cone("dome", "dome", (x, y, middle + join), bulge * math.cos(angle), 0.0, height)
    return lower + join + height


@is_thing
def spire(b: Builder, foot: Point, radius: float, height: float) -> None:
    """Add a steep pointed roof, round or with four or eight sides, with a cross on top."""
    if b.round_spires:
        b.cone("spire", "spire", foot, radius, 0.0, height)
    else:
        sides = int(b.rng.choice([4, 8]))
        b.prism("spire", "spire", foot, radius, height, sides, taper=1.0, yaw=0.0)
    if height > 5:
        bar = 0.03 * radius + 0.03
        x, y, z = foot
        b.box("spire", "trim", (x, y, z + height - 0.3), (bar, bar, 0.45 * radius + 0.6))
        b.box("spire", "trim", (x, y, z + height + 0.3 * radius), (bar, 5 * bar, bar))


@is_thing
def pinnacle(b: Builder, foot: Point, radius: float, height: float) -> None:
    """Add a small spire on a square shaft."""
    b.box("spire", "trim", foot, (radius * 1.7, radius * 1.7, height * 0.35))
    b.prism("spire", "spire", above(foot, height * 0.35), radius, height * 0.65, 4, taper=1.0)


@is_thing
def tower(
    b: Builder, foot: Point, width: float, height: float, top: str, sides=4, bare: tuple[float, ...] = ()
) -> None:
    """Add a tower in stories with belfry openings. `top` is spire, flat, pyramid, dome or onion; `bare` lists
    facings whose lowest story has no windows, for a portal."""
    x, y, z = foot
    if sides == 4:
        b.box("tower", "tower", foot, (width, width, height))
    else:
        b.prism("tower", "tower", foot, width / 2, height, sides, yaw=0.0)
    storeys = max(2, min(5, round(height / width / b.between(0.7, 1.1))))
    storey = height / storeys
    for i in range(1, storeys + 1):
        ledge = 0.35 + 0.02 * width
        size = width * (1.1 if i == storeys else 1.05)
        if sides == 4:
            b.box("tower", "trim", (x, y, z + i * storey - ledge), (size, size, ledge))
        else:
            b.prism("tower", "trim", (x, y, z + i * storey - ledge), size / 2, ledge, sides, yaw=0.0)
    columns = int(b.rng.integers(1, 4))
    for facing in (FRONT, LEFT, BACK, RIGHT):
        for i in range(storeys):
            if i == 0 and (facing in bare or storey < 4):
                continue
            place = ahead((x, y, z + i * storey + 0.15 * storey), facing, width / 2)
            field_ = width * (0.8 if sides == 4 else 0.38), storey * 0.66
            belfry = i == storeys - 1
            filling, across = "louvre" if belfry and b.lantern else None, columns - (not belfry)
            window_row(b, "tower", place, facing, *field_, max(1, across), filling=filling)
    _tower_top(b, (x, y, z + height), width, top)


def _tower_top(b: Builder, foot: Point, width: float, top: str) -> None:
    x, y, z = foot
    corners = [(sx * width * 0.44, sy * width * 0.44) for sx in (-1, 1) for sy in (-1, 1)]
    if top == "spire":
        spire(b, foot, width * 0.47, width * b.between(1.4, 2.8))
        if b.chance(0.5):
            for dx, dy in corners:
                pinnacle(b, (x + dx, y + dy, z), width * 0.09, width * 0.65)
    elif top == "flat":
        if b.chance(0.5):
            for dx, dy in corners:
                pinnacle(b, (x + dx, y + dy, z), width * 0.09, width * b.between(0.4, 0.8))
        else:
            battlements(b, foot, width)
    elif top == "pyramid":
        b.prism("roof", "roof", foot, width * 0.55, width * 0.42, 4, taper=1.0, yaw=0.0)
    else:
        dome(b, foot, width * 0.42, width * 0.14, windows=False, onion=top == "onion")


def battlements(b: Builder, foot: Point, width: float, count: int = 5) -> None:
    x, y, z = foot
    merlon = width / (2 * count - 1)
    for i in range(count):
        along = (2 * i - count + 1) * merlon * 0.98
        for side in (-1, 1):
            edge = side * (width / 2 - merlon * 0.3)
            b.box("tower", "tower", (x + along, y + edge, z), (merlon, merlon * 0.6, merlon * 1.1))
            b.box("tower", "tower", (x + edge, y + along, z), (merlon * 0.6, merlon, merlon * 1.1))


@is_thing
def minaret(
    b: Builder, foot: Point, radius: float, height: float, balconies: int, octagonal: bool, cap: str
) -> None:
    """Add a slender shaft with balconies. `cap` is cone, dome or lantern."""
    x, y, z = foot
    base = height * 0.14
    b.box("minaret", "wall", foot, (radius * 2.6, radius * 2.6, base))
    b.prism("minaret", "wall", (x, y, z + base), radius * 1.3, radius, 4, taper=0.45, yaw=0.0)
    heights = np.linspace(base, height * 0.82, balconies + 1)
    for low, high in zip(heights[:-1].tolist(), heights[1:].tolist(), strict=True):
        if octagonal:
            b.prism("minaret", "minaret", (x, y, z + low), radius, high - low, 8)
        else:
            b.cone("minaret", "minaret", (x, y, z + low), radius, radius * 0.95, high - low)
        b.cone("minaret", "trim", (x, y, z + high - radius * 0.8), radius * 0.95, radius * 1.65, radius * 0.8)
        b.cone("minaret", "trim", (x, y, z + high), radius * 1.65, radius * 1.65, radius * 0.6)
        radius *= 0.84
    top = z + height * 0.82
    b.cone("minaret", "minaret", (x, y, top), radius * 0.95, radius * 0.9, height * 0.08)
    top += height * 0.08
    if cap == "cone":
        b.cone("minaret", "cap", (x, y, top), radius * 1.2, 0.0, height * 0.13)
        top += height * 0.13
    elif cap == "dome":
        radii = (radius * 1.25, radius * 1.25, radius * 1.6)
        b.ellipsoid("minaret", "cap", (x, y, top + 0.4 * radius), radii, cut=-0.4 * radius)
        top += 2 * radius
    else:
        for i in range(6):
            place = ahead((x, y, top), i * math.pi / 3, radius * 0.75)
            b.cone("minaret", "trim", place, radius * 0.12, radius * 0.12, radius * 1.6)
        b.cone("minaret", "trim", (x, y, top + 1.6 * radius), radius * 1.15, radius * 1.15, radius * 0.3)
        b.ellipsoid("minaret", "cap", (x, y, top + 1.9 * radius), (radius, radius, radius * 1.1), cut=0.0)
        top += 3 * radius
    b.cone("minaret", "trim", (x, y, top - 0.2 * radius), radius * 0.12, 0.02, radius * 1.6)


def colonnade(b: Builder, start: Point, end: Point, count: int, height: float, radius: float) -> None:
    """Add a row of equal columns between two points, with bases and capitals."""
    for i in range(count):
        share = i / (count - 1)
        x, y = (s + (e - s) * share for s, e in zip(start[:2], end[:2], strict=True))
        z = start[2]
        b.cone("column", "column", (x, y, z), radius, radius * 0.86, height)
        b.box("column", "trim", (x, y, z + height - radius), (radius * 2.8, radius * 2.8, radius))
        b.box("column", "trim", (x, y, z), (radius * 2.8, radius * 2.8, radius * 0.8))


def chimney(b: Builder, foot: Point, height: float) -> None:
    """Add a smokestack, slender and round like a minaret."""
    radius = height * b.between(0.05, 0.08)
    x, y, z = foot
    b.cone("clutter", "wall", foot, radius * 1.15, radius, height)
    b.cone("clutter", "trim", (x, y, z + height), radius * 1.25, radius * 1.25, radius * 0.6)
