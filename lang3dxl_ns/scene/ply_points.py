"""Points of a PLY file with their colors, as laser scanners and photogrammetry programs write them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray as Array

from lang3dxl_ns.common.checks import FARTHEST, expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import readable
from lang3dxl_ns.common.files import open_file
from lang3dxl_ns.common.pictures import color_bytes

_HEADER = 1 << 16
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8", "half": "f2", "float16": "f2"},
    **{"int64": "i8", "uint64": "u8"},
}
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_HARMONICS, _C0 = ("f_dc_0", "f_dc_1", "f_dc_2"), 0.28209479177387814
"""Columns by which a splat tells its color, and the value of the constant harmonic."""


def read_ply_points(path: Path) -> tuple[Float64[Array, "m 3"], UInt8[Array, "m 3"]]:
    """Read the points of a PLY and their colors, which are gray if it has none. Points with invalid
    coordinates are skipped, and said to be. Raises UserError if the file is damaged or has no points."""
    with readable(f"the points of {path} can't be read", "export them again, or remove their name"):
        with open_file(path) as file:
            rows = _vertices(file, path.stat().st_size)
        names = {name.lower().removeprefix("scalar_"): name for name in rows.dtype.names or ()}
        expect(all(axis in names for axis in "xyz"), "it has no columns x, y, z")
        points = np.column_stack([rows[names[axis]].astype(np.float64) for axis in "xyz"])
    sound = (np.abs(points) < FARTHEST).all(axis=1)
    if not sound.all():
        say(f"{np.count_nonzero(~sound)} points of {path} are invalid and skipped")
    return points[sound], _colors(rows[sound], names, path)


def _colors(rows: Any, names: dict[str, str], path: Path) -> UInt8[Array, "m 3"]:
    for columns in _COLORS:
        if all(column in names for column in columns):
            return color_bytes(np.column_stack([rows[names[column]] for column in columns]))
    if all(column in names for column in _HARMONICS):
        shades = np.column_stack([rows[names[column]] for column in _HARMONICS]).astype(np.float64)
        return color_bytes((_C0 * shades + 0.5).clip(0, 1))
    say(f"the points of {path} have no colors and are gray")
    return np.full((len(rows), 3), 128, np.uint8)


def _vertices(file: BinaryIO, size: int) -> Any:
    """Read the rows of the table `vertex`, a structured array."""
    head = file.read(_HEADER)
    expect(head.startswith(b"ply"), "it doesn't begin like a PLY")
    end = re.search(rb"^end_header[ \t]*\r?\n", head, re.MULTILINE)
    if end is None:
        raise ValueError("its header doesn't end")
    form, order, tables = "", "<", dict[str, tuple[int, list[tuple[str, str]]]]()
    for line in head[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", form, *_]:
                orders = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
                expect(form in orders, f"its format is {form}")
                order = orders[form]
            case ["element", name, length]:
                expect(name not in tables and int(length) >= 0, f"it lists {name} twice, or less than none")
                tables[name] = (int(length), [])
            case ["property", "list", *_, name]:
                tables[list(tables)[-1]][1].append((name, ""))
            case ["property", kind, name]:
                expect(kind in _TYPES, f"its column {name} has the unknown type {kind}")
                tables[list(tables)[-1]][1].append((name, order + _TYPES[kind]))
    expect("vertex" in tables and bool(form), "it has no table of vertices")
    expect(next(iter(tables)) == "vertex", "its vertices don't come first")
    count, columns = tables["vertex"]
    expect(all(kind for _, kind in columns), "its vertices have lists")
    row = np.dtype(columns)
    file.seek(end.end())
    if form == "ascii":
        expect(2 * count * len(columns) <= size, "it announces more vertices than it holds")
        numbers = np.array(file.read().split()[: count * len(columns)], dtype=np.float64)
        expect(len(numbers) == count * len(columns), "it announces more vertices than it holds")
        table = numbers.reshape(count, len(columns))
        rows = np.zeros(count, row)
        with np.errstate(invalid="ignore", over="ignore"):  # text may hold any number
            for i, (name, _) in enumerate(columns):
                rows[name] = table[:, i]
        return rows
    expect(count * row.itemsize <= size - end.end(), "it announces more vertices than it holds")
    return np.frombuffer(file.read(count * row.itemsize), row)
