"""Surroundings of a landmark: permanent ground, trees, houses and lamps; transient people and cars."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from lab.landmark.labels import PART
from lab.landmark.materials import MASONRY, colored, make_material
from lab.landmark.openings import Openings
from lab.landmark.shape_list import Point, ShapeList
from lab.landmark.vocabulary import Builder, above, ahead


def place_surroundings(b: Builder, center, radius: float) -> None:
    """Add the ground and a ring of trees, houses and lamps to the builder's shapes."""
    rng = b.rng
    for role in ("grass", "gravel", "paving", "foliage", "bark", "iron"):
        b.role[role] = b.add_material(make_material(role, rng))
    b.role["darker foliage"] = b.add_material(make_material("foliage", rng, tint=0.2))
    lawn = str(rng.choice(["grass", "gravel", "paving"]))
    b.box("ground", lawn, (0, 0, -1.0), (3000, 3000, 1))
    x, y = float(center[0]), float(center[1])
    if b.chance(0.7):
        forecourt = str(rng.choice(["paving", "gravel"]))
        b.box("ground", forecourt, (x + radius * 0.5, y, 0), (radius * 2.6, radius * 1.7, 0.02))

    def somewhere(nearest: float, farthest: float, spread: float = math.pi) -> Point:
        angle, distance = rng.uniform(-spread, spread), radius * rng.uniform(nearest, farthest)
        return x + math.cos(angle) * distance, y + math.sin(angle) * distance, 0.0

    for _ in range(int(rng.integers(2, 10))):
        _tree(b, somewhere(1.15, 1.9))
    for _ in range(int(rng.integers(4, 9))):
        _house(b, somewhere(2.6, 5.0))
    for _ in range(int(rng.integers(0, 5))):
        _lamp(b, somewhere(0.95, 1.5, 1.2))


def passers_by(
    rng: np.random.Generator, spots: Callable[[], Point | None], people: int, cars: int
) -> ShapeList:
    """Place people and cars at the given spots, with their own materials."""
    crowd = ShapeList(rng)
    for add, count in ((_person, people), (_car, cars)):
        for _ in range(count):
            spot = spots()
            if spot is not None:
                add(crowd, spot)
    return crowd


def _tree(b: Builder, foot: Point) -> None:
    height, leaves = b.between(4, 11), "foliage" if b.chance(0.6) else "darker foliage"
    x, y, _ = foot
    b.cone("tree", "bark", foot, height * 0.035, height * 0.02, height * 0.6)
    if b.chance(0.3):  # cypress or fir, pointed like a spire
        if b.chance(0.5):
            b.cone("tree", leaves, (x, y, height * 0.12), height * b.between(0.1, 0.2), 0.0, height)
        else:
            for i in range(3):
                part = (x, y, height * (0.12 + 0.26 * i))
                b.cone("tree", leaves, part, height * (0.24 - 0.06 * i), 0.0, height * 0.46)
        return
    for _ in range(5):
        r = height * b.between(0.16, 0.26)
        dx, dy = (height * b.between(-0.15, 0.15) for _ in range(2))
        blob = (x + dx, y + dy, height * b.between(0.55, 0.85))
        b.ellipsoid("tree", leaves, blob, (r, r, r * b.between(0.8, 1.1)))


def _house(b: Builder, foot: Point) -> None:
    width, depth, height = b.between(7, 12), b.between(8, 16), b.between(4, 9)
    yaw = b.between(0, math.pi)
    b.role["house"] = b.add_material(make_material(str(b.rng.choice(MASONRY)), b.rng))
    b.box("house", "house", foot, (width, depth, height), yaw)
    if b.chance(0.8):
        rise = width * b.between(0.3, 0.5)
        b.gable("house", "roof", above(foot, height), width * 1.1, depth * 1.05, rise, yaw)
    for turn, across, out in ((0, depth, width), (math.pi / 2, width, depth), (math.pi, depth, width)):
        facing = yaw + turn
        wall = ahead((foot[0], foot[1], 0.4), facing, out / 2 + 0.04)
        windows = Openings(
            PART["house"], b.role["glass"], wall, facing, 0, trim_material=b.role["house"],
            field=(across * 0.9, height - 0.6), columns=max(2, int(across / 2.6)),
            rows=max(1, int(height / 2.8)), width=1.0, height=1.5, outline="rectangle", filling="mullion",
            depth=0.2, orders=1, step=0.06, surround=0.12,
        )  # fmt: skip
        b.shapes.append(windows)


def _lamp(b: Builder, foot: Point) -> None:
    height = b.between(4, 7)
    b.cone("lamp", "iron", foot, 0.13, 0.07, height)
    b.ellipsoid("lamp", "trim", above(foot, height), (0.32, 0.32, 0.4))


def _person(b: ShapeList, foot: Point) -> None:
    rng = b.rng
    for role in ("coat", "trousers"):
        b.role[role] = b.add_material(colored("cloth", rng))
    b.role["skin"] = b.add_material(make_material("skin", rng, tint=0.15))
    x, y, z = foot
    size, yaw = b.between(0.88, 1.08), b.between(0, 2 * math.pi)
    for side in (-1, 1):
        leg = ahead(foot, yaw, side * 0.12 * size)
        b.cone("person", "trousers", leg, 0.08 * size, 0.12 * size, 0.85 * size)
        arm = ahead((x, y, z + 1.1 * size), yaw, side * 0.27 * size)
        b.ellipsoid("person", "coat", arm, (0.08 * size, 0.08 * size, 0.33 * size))
    b.ellipsoid("person", "coat", (x, y, z + 1.13 * size), (0.24 * size, 0.2 * size, 0.4 * size))
    b.ellipsoid("person", "skin", (x, y, z + 1.63 * size), (0.11 * size, 0.11 * size, 0.14 * size))


def _car(b: ShapeList, foot: Point) -> None:
    rng = b.rng
    b.role["body"] = b.add_material(colored("paint", rng))
    for role in ("glass", "iron"):
        b.role[role] = b.add_material(make_material(role, rng))
    yaw, length = b.between(0, math.pi), b.between(3.8, 4.8)
    b.box("car", "body", above(foot, 0.3), (length, 1.8, 0.6), yaw)
    cabin = ahead(above(foot, 0.9), yaw, -0.2)
    b.box("car", "glass", cabin, (length * 0.52, 1.6, 0.42), yaw)
    b.box("car", "body", (cabin[0], cabin[1], foot[2] + 1.32), (length * 0.44, 1.55, 0.1), yaw)
    for along in (-1, 1):
        for side in (-1, 1):
            hub = ahead(above(foot, 0.32), yaw, along * length * 0.31, side * 0.88)
            b.ellipsoid("car", "iron", hub, (0.33, 0.33, 0.33))
