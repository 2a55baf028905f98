"""Tables of a PLY file, in any types, byte order and form."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError

_LONGEST_HEADER = 1 << 16
"""Most bytes that the header may take."""
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "half": "f2", "float16": "f2"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


@dataclass(eq=False)
class Table:
    """Table that the header announces."""

    length: int
    columns: list[tuple[str, str]] = field(default_factory=list)
    """Name and type of each column; a list is a column of its length's type."""
    lists: dict[str, str] = field(default_factory=dict)
    """Type of the items of each column that is a list."""

    def row(self, lengths: dict[str, int] | None = None) -> np.dtype[Any]:
        """Return the type of a row, whose lists have these lengths (default: none)."""
        parts: list[tuple[Any, ...]] = []
        for name, kind in self.columns:
            parts.append((name, kind))
            if name in self.lists:
                parts.append((f"{name} items", self.lists[name], ((lengths or {}).get(name, 0),)))
        return np.dtype(parts)


def read_header(file: BinaryIO) -> tuple[str, dict[str, Table], list[str]]:
    """Read the form, the tables in the file's order, and all lines of the header. The file is left at the
    first table's data. Tells of rows that no table announces. Raises UserError for a column of an unknown
    type, and one of `DAMAGE` for a damaged file."""
    head = file.read(_LONGEST_HEADER)
    expect(head.startswith(b"ply"), "it doesn't begin like a PLY")
    end = re.search(rb"^end_header[ \t]*\r?\n", head, re.MULTILINE)
    if end is None:
        raise ValueError("its header doesn't end")
    form, order, tables, table = "", "<", dict[str, Table](), Table(0)
    lines = head[: end.start()].decode("latin-1").split("\n")  # comments may hold other line breaks
    for line in lines:
        match line.split():
            case ["format", form, *_]:
                order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
            case ["element", name, count]:
                expect(name not in tables and int(count) >= 0, f"it lists {name} twice, or less than none")
                table = tables[name] = Table(int(count))
            case ["property", "list", length, kind, column]:
                table.columns.append((column, order + _type(length, column)))
                table.lists[column] = order + _type(kind, column)
            case ["property", kind, column]:
                table.columns.append((column, order + _type(kind, column)))
    size = file.seek(0, 2) - file.seek(end.end())
    announced = sum(table.length * table.row().itemsize for table in tables.values())
    expect(form == "ascii" or announced <= size, "it announces more than it holds")
    row = 0 if form == "ascii" or any(table.lists for table in tables.values()) else table.row().itemsize
    if row and announced and size - announced >= row:
        say(f"{file.name} holds {(size - announced) // row} rows more than its header announces: left out")
    return form, tables, lines


def _type(name: str, column: str) -> str:
    if name not in _TYPES:
        raise UserError(f"its column {column} has the type {name}, which PLY lacks: export it again")
    return _TYPES[name]


def read_vertices(file: BinaryIO, form: str, tables: dict[str, Table]) -> dict[str, Any]:
    """Read the columns [n, …] of the table `vertex`, from where `read_header` left the file. Raises UserError
    for lists that cannot be read, and one of `DAMAGE` for a damaged file."""
    before = list(tables.values())[: list(tables).index("vertex")]
    expect(not any(table.lists for table in before), "its points come after lists")
    if form == "ascii":
        return _ascii_columns(file, before, tables["vertex"], len(tables) == len(before) + 1)
    return _binary_columns(file, before, tables["vertex"])


def plainly(columns: dict[str, Any]) -> dict[str, Any]:
    """Name columns in small letters and without CloudCompare's prefix; those already named so win."""
    return {name.lower().removeprefix("scalar_"): column for name, column in columns.items()} | columns


def _binary_columns(file: BinaryIO, before: list[Table], vertices: Table) -> dict[str, Any]:
    file.seek(sum(table.length * table.row().itemsize for table in before), 1)
    start, lengths = file.tell(), dict[str, int]()
    for name in vertices.lists:  # the first row tells how long all rows' lists are
        row = vertices.row(lengths)
        first = np.fromfile(file, row, 1)
        lengths[name] = int(first[name][0]) if len(first) else 0
        file.seek(start)
        left = file.seek(0, 2) - start
        expect(0 <= lengths[name] * vertices.length <= left, f"its lists {name} are longer than the file")
        file.seek(start)
    rows = np.fromfile(file, vertices.row(lengths), vertices.length)
    expect(len(rows) == vertices.length, "it announces more than it holds")
    if uneven := [name for name, length in lengths.items() if (rows[name] != length).any()]:
        raise UserError(f"its points hold lists {uneven[0]} of different lengths: export it without them")
    return {name: rows[name] for name in rows.dtype.names or ()}


def _ascii_columns(file: BinaryIO, before: list[Table], vertices: Table, last: bool) -> dict[str, Any]:
    columns = vertices.columns
    if vertices.lists:
        raise UserError(f"its points hold lists {next(iter(vertices.lists))} as text: export it as binary")
    try:
        numbers = np.fromstring(file.read().decode("latin-1"), sep=" ")
    except ValueError as error:  # before 2.3, numpy reads up to there
        raise ValueError("it holds something else than numbers") from error
    skipped = sum(table.length * len(table.columns) for table in before)
    expected = vertices.length * len(columns)
    found = len(numbers) - skipped
    expect(found == expected or (found > expected and not last), f"it has {found} numbers, not {expected}")
    rows = numbers[skipped : skipped + expected].reshape(vertices.length, len(columns))
    with np.errstate(invalid="ignore", over="ignore"):  # text may hold any number
        return {name: rows[:, i].astype(kind) for i, (name, kind) in enumerate(columns)}
