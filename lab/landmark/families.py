"""Three families of landmarks, each a grammar over the vocabulary's parts. Façades face +x."""

from __future__ import annotations

import math

from lab.landmark.vocabulary import (
    BACK,
    FRONT,
    LEFT,
    RIGHT,
    Builder,
    ahead,
    chimney,
    colonnade,
    dome,
    minaret,
    niche_row,
    pinnacle,
    portal,
    rose_window,
    spire,
    tower,
    window_row,
)

SIDES = ((LEFT, 1), (RIGHT, -1))
"""Facing of the long sides, and the sign of y there."""


def cathedral(b: Builder) -> None:
    """Build a nave with aisles, an optional transept and apse, and up to two towers."""
    width, length, height = b.between(10, 14), b.between(30, 46), b.between(14, 22)
    ridge = width * b.between(0.5, 0.95)
    aisle, aisle_height = width * b.between(0.4, 0.55), height * b.between(0.45, 0.58)
    tower_width, tower_height = width * b.between(0.55, 0.75), height * b.between(1.35, 2.0)
    b.facade_height = tower_height * 1.3  # with what stands on the towers

    b.box("wall", "wall", (-length / 2, 0, 0), (length, width, height))
    b.gable("roof", "roof", (-length / 2, 0, height), width * 1.07, length, ridge, yaw=math.pi / 2)
    b.gable("wall", "wall", (-0.3, 0, height), width, 0.9, ridge * 1.02, yaw=math.pi / 2)
    bays = int(b.rng.integers(5, 9))
    _aisles(b, width, length, height, aisle, aisle_height, bays)
    if b.chance(0.7):
        _transept(b, width, length, height, ridge, aisle)
    if b.chance(0.6):
        b.cone("wall", "wall", (-length, 0, 0), width * 0.48, width * 0.48, height * 0.85)
        b.cone("roof", "roof", (-length, 0, height * 0.85), width * 0.52, 0.0, ridge * 0.8)
        for i in range(-2, 3):
            facing = BACK + i * math.pi / 5
            foot = ahead((-length, 0, height * 0.25), facing, width * 0.48)
            window_row(b, "wall", foot, facing, width * 0.24, height * 0.45, columns=1)
    if b.chance(0.5):
        side = b.rng.choice([-1, 1])
        sacristy = (-length * 0.8, side * (width / 2 + aisle * 1.5), 0.0)
        b.box("wall", "wall", sacristy, (7, aisle, aisle_height * 0.6))
        chimney(b, (sacristy[0], sacristy[1], aisle_height * 0.6), b.between(4, 9))
    _west_front(b, width, height, aisle, tower_width, tower_height)


def _aisles(b: Builder, width, length, height, aisle, aisle_height, bays) -> None:
    buttresses, pinnacles = b.chance(0.7), b.chance(0.6)
    for facing, side in SIDES:
        y = side * (width / 2 + aisle / 2)
        b.box("wall", "wall", (-length / 2, y, 0), (length * 0.96, aisle, aisle_height))
        x, inside, above = -length / 2, side * width / 2, aisle_height + aisle * 0.5
        roof = (aisle * 2.1, length * 0.97, aisle * 0.45)
        b.gable("roof", "roof", (x, inside, aisle_height), *roof, yaw=math.pi / 2)
        window_row(b, "wall", (x, inside, above), facing, length * 0.94, height - above - 0.4, bays)
        outside = (-length / 2, side * (width / 2 + aisle), aisle_height * 0.16)
        window_row(b, "wall", outside, facing, length * 0.92, aisle_height * 0.72, bays)
        if not buttresses:
            continue
        for i in range(bays + 1):
            x, y = -length * 0.04 - length * 0.92 * i / bays, side * (width / 2 + aisle + 0.5)
            b.box("wall", "trim", (x, y, 0), (0.9, 1.3, aisle_height * 1.05))
            if pinnacles:
                pinnacle(b, (x, y, aisle_height * 1.05), 0.55, 3.6)


def _transept(b: Builder, width, length, height, ridge, aisle) -> None:
    x, across, reach = -length * b.between(0.55, 0.7), width * 0.8, width + 2 * aisle + b.between(4, 9)
    b.box("wall", "wall", (x, 0, 0), (across, reach, height))
    b.gable("roof", "roof", (x, 0, height), across * 1.05, reach, ridge * 0.9)
    rose = b.chance(0.5)
    for facing, side in SIDES:
        y = side * reach / 2
        b.gable("wall", "wall", (x, side * (reach / 2 - 0.2), height), across, 0.9, ridge * 0.92)
        if rose:
            rose_window(b, "wall", (x, y, height * 0.55), facing, across * 0.5)
        else:
            window_row(b, "wall", (x, y, height * 0.42), facing, across * 0.85, height * 0.5, 3)
        portal(b, "wall", (x, y, 0), facing, across * 0.32, height * 0.33)
    crossing = b.rng.random()
    if crossing < 0.4:
        dome(b, (x, 0, height + ridge * 0.3), width * 0.5, width * 0.55)
    elif crossing < 0.75:
        tower(b, (x, 0, height), width * 0.5, ridge * 1.2 + 3, "spire" if b.chance(0.8) else "flat")
    else:
        spire(b, (x, 0, height + ridge * 0.75), width * 0.14, height * 0.9)


def _west_front(b: Builder, width, height, aisle, tower_width, tower_height) -> None:
    top = "spire" if b.chance(0.55) else str(b.rng.choice(["flat", "dome", "onion", "pyramid"]))
    arrangement = b.rng.random()
    twin = arrangement < 0.6
    if twin:
        beside = width / 2 + tower_width * 0.45
        for side in (-1, 1):
            foot = (-tower_width / 2 + 0.9, side * beside, 0)
            tower(b, foot, tower_width, tower_height, top, bare=(FRONT,))
            portal(b, "tower", (0.9, side * beside, 0), FRONT, tower_width * 0.42, height * 0.3)
    if twin or arrangement >= 0.85:
        portal(b, "wall", (0.15, 0, 0), FRONT, width * b.between(0.34, 0.46), height * b.between(0.38, 0.46))
        if b.chance(0.7):
            rose_window(b, "wall", (0.15, 0, height * 0.58), FRONT, width * 0.55)
        else:
            columns = int(b.rng.integers(1, 4))
            window_row(b, "wall", (0.15, 0, height * 0.56), FRONT, width * 0.62, height * 0.42, columns)
        if b.chance(0.5):
            columns = int(b.rng.integers(6, 11))
            niche_row(b, (0.15, 0, height * 0.485), FRONT, width * 0.8, height * 0.085, columns)
    else:
        across = tower_width * 1.15
        tower(b, (across * 0.3, 0, 0), across, tower_height * 1.1, top, bare=(FRONT,))
        portal(b, "tower", (across * 0.8, 0, 0), FRONT, across * 0.5, height * 0.4)
        for side in (-1, 1):
            y = side * (width / 2 + aisle / 2)
            window_row(b, "wall", (-0.02 * height, y, 1.5), FRONT, aisle * 0.8, height * 0.35, 1)
    if not twin and b.chance(0.7):
        for side in (-1, 1):
            pinnacle(b, (-0.3, side * width * 0.47, height), 0.9, height * 0.35)


def mosque(b: Builder) -> None:
    """Build a domed prayer hall with one to six minarets, sometimes with a court in front."""
    width = b.between(20, 31)
    depth, height, radius = width * b.between(0.8, 1.1), b.between(9, 13), width * b.between(0.22, 0.31)
    b.facade_height = height * 2.8  # with its minarets
    b.box("wall", "wall", (0, 0, 0), (depth, width, height))
    b.box("wall", "trim", (0, 0, height - 0.5), (depth * 1.02, width * 1.02, 0.9))
    shoulder = height * b.between(0.25, 0.5)
    b.box("wall", "wall", (0, 0, height), (radius * 2.4, radius * 2.4, shoulder))
    dome(b, (0, 0, height + shoulder), radius, radius * b.between(0.3, 0.6))
    if b.chance(0.6):  # half domes against the shoulder
        for facing in (FRONT, LEFT, BACK, RIGHT):
            x, y, z = ahead((0, 0, height), facing, radius * 1.2)
            b.ellipsoid("dome", "dome", (x, y, z), (radius * 0.75, radius * 0.75, radius * 0.62), cut=0.0)
    if b.chance(0.7):
        small = radius * b.between(0.26, 0.34)
        for sx in (-1, 1):
            for sy in (-1, 1):
                dome(b, (sx * depth * 0.38, sy * width * 0.38, height), small, 1.2, windows=False)
    rows = int(b.rng.integers(1, 4))
    for facing, across, out in ((LEFT, depth, width), (RIGHT, depth, width), (BACK, width, depth)):
        foot = ahead((0, 0, height * 0.17), facing, out / 2)
        window_row(b, "wall", foot, facing, across * 0.9, height * 0.7, rows=rows)
    court = b.chance(0.55)
    front = _court(b, width, depth, height) if court else _plain_front(b, width, depth, height, rows)
    _minarets(b, width, depth, height, front, court)
    if b.chance(0.25):
        top = str(b.rng.choice(["flat", "dome", "onion"]))
        for side in (-1, 1):
            tower(b, (depth / 2, side * width / 2, 0), width * 0.15, height * 1.5, top)
    if b.chance(0.35):
        chimney(b, (-depth * 0.42, b.rng.choice([-1, 1]) * width * 0.2, height), b.between(4, 8))


def _court(b: Builder, width, depth, height) -> float:
    """Build an arcaded court in front of the hall, and return x of its front."""
    reach, wall = depth * b.between(0.6, 0.9), height * 0.55
    window_row(b, "wall", (depth / 2, 0, height * 0.6), FRONT, width * 0.9, height * 0.3)
    for facing, side in SIDES:
        b.box("wall", "wall", (depth / 2 + reach / 2, side * (width / 2 - 0.5), 0), (reach, 1, wall))
        foot = (depth / 2 + reach / 2, side * width / 2, wall * 0.2)
        window_row(b, "wall", foot, facing, reach * 0.9, wall * 0.65)
    front = depth / 2 + reach
    b.box("wall", "wall", (front, 0, 0), (1, width, wall))
    bays = int(b.rng.integers(5, 9))
    colonnade(b, (front + 3, -width * 0.47, 0), (front + 3, width * 0.47, 0), 2 * bays, wall * 0.8, 0.32)
    b.box("roof", "trim", (front + 1.7, 0, wall * 0.8), (4.2, width, wall * 0.14))
    for i in range(bays):
        y, r = (i - (bays - 1) / 2) / bays * width, width / bays * 0.4
        b.ellipsoid("dome", "dome", (front + 1.7, y, wall * 0.94), (r, r, r * 0.85), cut=0.0)
    gate, tall = width * b.between(0.14, 0.2), height * b.between(0.62, 0.8)
    b.box("wall", "wall", (front + 2, 0, 0), (5, gate * 1.8, tall * 1.25))
    portal(b, "wall", (front + 4.5, 0, 0), FRONT, gate, tall)
    return front


def _plain_front(b: Builder, width, depth, height, rows) -> float:
    gate, tall = width * b.between(0.15, 0.24), height * b.between(0.75, 1.05)
    b.box("wall", "wall", (depth / 2 + 0.8, 0, 0), (2.4, gate * 1.7, tall * 1.2))
    portal(b, "wall", (depth / 2 + 2, 0, 0), FRONT, gate, tall)
    for side in (-1, 1):
        foot = (depth / 2, side * width * 0.33, height * 0.14)
        window_row(b, "wall", foot, FRONT, width * 0.26, height * 0.72, rows=rows)
    if b.chance(0.4):
        for side in (-1, 1):
            foot = (depth / 2 + 2, side * gate * 0.68, tall * 0.15)
            niche_row(b, foot, FRONT, gate * 0.3, tall * 0.3, 1)
    return depth / 2


def _minarets(b: Builder, width, depth, height, front, court) -> None:
    count = int(b.rng.choice([1, 2, 2, 4, 4, 6]))
    tall, radius = height * b.between(2.6, 3.8), width * b.between(0.028, 0.044)
    aside = width / 2 + radius * 1.5
    lines = (-depth / 2, depth / 2, front + 0.5)
    rear, middle, fore = ([(x, side * aside, 0.0) for side in (1, -1)] for x in lines)
    four, six = middle + (fore if court else rear), rear + middle + (fore if court else [])
    places = {1: middle[:1], 2: fore, 4: four, 6: six}
    octagonal, balconies = b.chance(0.4), int(b.rng.integers(1, 4))
    cap = str(b.rng.choice(["cone", "dome", "lantern"]))
    for place in places[count]:
        minaret(b, place, radius, tall, balconies, octagonal, cap)


def hall(b: Builder) -> None:
    """Build a synagogue-like hall: a large cube under one dome, or a house between two towers."""
    width, height = b.between(14, 20), b.between(11, 15)
    depth = width * b.between(0.9, 1.4)
    b.facade_height = height * 2.1  # with its dome or towers
    b.box("wall", "wall", (0, 0, 0), (depth, width, height))
    b.box("wall", "trim", (0, 0, height - 0.5), (depth * 1.03, width * 1.03, 0.8))
    if b.chance(0.55):
        _great_dome(b, width, depth, height)
    else:
        _two_towers(b, width, depth, height)
    for facing in (LEFT, RIGHT, BACK):
        across, out = (width, depth) if facing == BACK else (depth, width)
        foot = ahead((0, 0, height * 0.14), facing, out / 2)
        window_row(b, "wall", foot, facing, across * 0.68, height * 0.76, rows=int(b.rng.integers(1, 4)))
    _hall_front(b, width, depth, height)
    if b.chance(0.4):
        chimney(b, (-depth * 0.3, b.rng.choice([-1, 1]) * width * 0.36, height), b.between(3, 7))


def _great_dome(b: Builder, width, depth, height) -> None:
    radius = min(width, depth) * b.between(0.34, 0.44)
    dome(b, (0, 0, height), radius, radius * b.between(0.4, 0.7))
    corner, top = width * b.between(0.15, 0.2), str(b.rng.choice(["dome", "flat", "pyramid", "spire"]))
    for sx in (-1, 1):
        for sy in (-1, 1):
            place = (sx * (depth / 2 - corner * 0.3), sy * (width / 2 - corner * 0.3), 0.0)
            tower(b, place, corner, height * 1.25, top)


def _two_towers(b: Builder, width, depth, height) -> None:
    across, tall = width * b.between(0.24, 0.32), height * b.between(1.4, 2.0)
    top = str(b.rng.choice(["onion", "onion", "dome", "flat", "spire"]))
    sides = int(b.rng.choice([4, 4, 8]))
    for side in (-1, 1):
        tower(b, (depth / 2 - across * 0.3, side * width / 2, 0), across, tall, top, sides)
    if b.chance(0.6):
        dome(b, (-depth * 0.1, 0, height), width * 0.29, width * 0.12)
    else:
        rise, gable = width * 0.35, (depth / 2 - 0.4, 0, height)
        b.gable("roof", "roof", (0, 0, height), width, depth, rise, yaw=math.pi / 2)
        b.gable("wall", "wall", gable, width * 0.94, 0.9, rise, yaw=math.pi / 2)


def _hall_front(b: Builder, width, depth, height) -> None:
    x, tall = depth / 2, height * b.between(0.3, 0.38)
    portal(b, "wall", (x, 0.0, 0.0), FRONT, width * b.between(0.14, 0.2), tall)
    if b.chance(0.55):
        for side in (-1, 1):
            portal(b, "wall", (x, side * width * 0.22, 0), FRONT, width * 0.11, tall * 0.75)
    upper = (x, 0.0, height * 0.5)
    if b.chance(0.3):
        rose_window(b, "wall", upper, FRONT, height * 0.3)
        for side in (-1, 1):
            foot = (x, side * width * 0.25, height * 0.5)
            window_row(b, "wall", foot, FRONT, width * 0.14, height * 0.36, 1)
    else:
        window_row(b, "wall", upper, FRONT, width * 0.62, height * 0.4)
    if b.chance(0.35):
        ends = (x + 2.6, -width * 0.34, 0), (x + 2.6, width * 0.34, 0)
        colonnade(b, *ends, 6, height * 0.4, 0.42)
        b.box("roof", "trim", (x + 1.5, 0, height * 0.4), (3.2, width * 0.76, 0.8))
    elif b.chance(0.6):
        columns = int(b.rng.integers(5, 9))
        niche_row(b, (x, 0, height * 0.41), FRONT, width * 0.6, height * 0.09, columns)
