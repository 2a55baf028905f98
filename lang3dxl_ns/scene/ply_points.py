"""Points of a PLY file with their colors, as laser scanners and photogrammetry programs write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray as Array

from lang3dxl_ns.common.checks import FARTHEST, expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import open_file
from lang3dxl_ns.common.pictures import color_bytes
from lang3dxl_ns.common.ply_tables import plainly, read_header, read_vertices

_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_HARMONICS, _C0 = ("f_dc_0", "f_dc_1", "f_dc_2"), 0.28209479177387814
"""Columns by which a splat tells its color, and the value of the constant harmonic."""


def read_ply_points(path: Path) -> tuple[Float64[Array, "m 3"], UInt8[Array, "m 3"]]:
    """Read the points of a PLY and their colors, which are gray if it has none. Points with invalid
    coordinates are skipped, and said to be. Raises UserError if the file is damaged or has no points."""
    with readable(f"the points of {path} can't be read", "export them again, or remove their name"):
        with open_file(path) as file:
            try:
                form, tables, _ = read_header(file)
                expect("vertex" in tables and bool(form), "it has no table of vertices")
                columns = read_vertices(file, form, tables)
            except UserError as error:
                raise UserError(f"{path}: {error}") from error
        named = plainly(columns)
        expect(all(axis in named for axis in "xyz"), "it has no columns x, y, z")
        points = np.column_stack([named[axis].astype(np.float64) for axis in "xyz"])
    sound = (np.abs(points) < FARTHEST).all(axis=1)
    if not sound.all():
        say(f"{np.count_nonzero(~sound)} points of {path} are invalid and skipped")
    return points[sound], _colors(named, path)[sound]


def _colors(named: dict[str, Any], path: Path) -> UInt8[Array, "m 3"]:
    for columns in _COLORS:
        if all(column in named for column in columns):
            return color_bytes(np.column_stack([named[column] for column in columns]))
    if all(column in named for column in _HARMONICS):
        shades = np.column_stack([named[column] for column in _HARMONICS]).astype(np.float64)
        return color_bytes((_C0 * shades + 0.5).clip(0, 1))
    say(f"the points of {path} have no colors and are gray")
    return np.full((len(named["x"]), 3), 128, np.uint8)
