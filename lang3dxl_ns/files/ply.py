"""PLY of splats: as 3D Gaussian splatting writes it, in any types, byte order and form, and SuperSplat's."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.activations import ALL_BANDS, activated, array_of, check_memory, log_scales, logits
from lang3dxl_ns.rendering import Splats, harmonics_of

_LONGEST_HEADER = 1 << 16
"""Most bytes that the header may take."""
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "half": "f2", "float16": "f2"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_NEEDED = ("x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3")
_ANTIALIASED = re.compile(r"comment\s+(splatrendermode:\s*mip|antialiased:?\s*(1|true))\s*", re.IGNORECASE)
"""Comments by which programs tell that a splat was trained with antialiasing."""


@dataclass(eq=False)
class _Table:
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


def read_ply(path: Path) -> Splats:
    """Read the Gaussians of a PLY. Raises UserError for a point cloud and for columns of unknown types, and
    one of `DAMAGE` for a damaged file."""
    with path.open("rb") as file:
        form, tables, antialiased = _read_header(file)
        vertices = tables.get("vertex", _Table(0))
        names = [name for name, _ in vertices.columns]
        if form != "ascii":
            announced = sum(table.length * table.row().itemsize for table in tables.values())
            expect(announced <= path.stat().st_size - file.tell(), "it announces more than it holds")
        if "chunk" in tables and "packed_position" in names:
            return _supersplat(path, tables)
        # CloudCompare names all columns but the coordinates so.
        known = {name.removeprefix("scalar_"): name for name in names}
        if missing := [name for name in _NEEDED if name not in known]:
            raise UserError(f"not a splat but a point cloud: its points have no {', '.join(missing[:3])}")
        check_memory(vertices.length, 1 + sum(name.startswith("f_rest_") for name in known) // 3)
        before = list(tables.values())[: list(tables).index("vertex")]
        if form == "ascii":
            columns = _ascii_columns(file, before, vertices, len(tables) == len(before) + 1)
        else:
            columns = _binary_columns(file, before, vertices)
        splats = _splats_of({plain: columns[name] for plain, name in known.items() if name in columns})
        return replace(splats, antialiased=antialiased)


def _read_header(file: BinaryIO) -> tuple[str, dict[str, _Table], bool]:
    """Read the form, the tables in the file's order, and whether a comment tells of antialiasing. The file
    is left at the first table's data."""
    head = file.read(_LONGEST_HEADER)
    expect(head.startswith(b"ply"), "it doesn't begin like a PLY")
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if end is None:
        raise ValueError("its header doesn't end")
    form, order, tables, table, antialiased = "", "<", dict[str, _Table](), _Table(0), False
    for line in head[: end.start()].decode("latin-1").splitlines():
        antialiased |= bool(_ANTIALIASED.fullmatch(line))
        match line.split():
            case ["format", form, *_]:
                order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
            case ["element", name, count]:
                expect(name not in tables and int(count) >= 0, f"it lists {name} twice, or less than none")
                table = tables[name] = _Table(int(count))
            case ["property", "list", length, kind, column]:
                table.columns.append((column, order + _type(length, column)))
                table.lists[column] = order + _type(kind, column)
            case ["property", kind, column]:
                table.columns.append((column, order + _type(kind, column)))
    file.seek(end.end())
    return form, tables, antialiased


def _type(name: str, column: str) -> str:
    if name not in _TYPES:
        raise UserError(f"its column {column} has the type {name}, which no PLY has: export it anew")
    return _TYPES[name]


def _binary_columns(file: BinaryIO, before: list[_Table], vertices: _Table) -> Any:
    expect(not any(table.lists for table in before), "its points come after lists")
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


def _ascii_columns(file: BinaryIO, before: list[_Table], vertices: _Table, last: bool) -> Any:
    names = [name for name, _ in vertices.columns]
    if vertices.lists:
        raise UserError(f"its points hold lists {next(iter(vertices.lists))} as text: export it as binary")
    expect(not any(table.lists for table in before), "its points come after lists")
    numbers = np.fromstring(file.read().decode("latin-1"), sep=" ", dtype=np.float32)
    skipped = sum(table.length * len(table.columns) for table in before)
    expected = vertices.length * len(names)
    found = len(numbers) - skipped
    expect(found == expected or (found > expected and not last), f"it has {found} numbers, not {expected}")
    rows = numbers[skipped : skipped + expected].reshape(vertices.length, len(names))
    return {name: rows[:, i] for i, name in enumerate(names)}


def _splats_of(table: Any) -> Splats:
    """Build splats from the columns that 3D Gaussian splatting writes."""

    def columns(*names: str) -> Float[Tensor, "n k"]:
        return torch.from_numpy(np.stack([table[name].astype(np.float32) for name in names], axis=1))

    rest = sorted(filter(re.compile(r"f_rest_\d+").fullmatch, table), key=lambda name: int(name[7:]))
    if "f_dc_0" in table:
        first = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    else:
        colors = columns("red", "green", "blue")  # 0 to 255, or 0 to 1
        first = harmonics_of(colors / (255 if (colors > 1).any() else 1))
    if len(rest) not in (0, 9, 24, 45, 72):
        raise UserError(f"it has {len(rest)} columns f_rest, not 9, 24, 45 or 72: export it anew")
    # Coefficients are stored channel by channel.
    others = columns(*rest).reshape(len(first), 3, len(rest) // 3).mT if rest else first[:, :0]
    scales = columns("scale_0", "scale_1")
    # A flat Gaussian (2D Gaussian splatting) has only two scales.
    third = columns("scale_2") if "scale_2" in table else scales.amin(1, keepdim=True) - 5
    quats, scales = columns("rot_0", "rot_1", "rot_2", "rot_3"), torch.cat([scales, third], dim=1)
    harmonics = torch.cat([first, others], dim=1)
    return activated(columns("x", "y", "z"), scales, quats, columns("opacity"), harmonics)


def _supersplat(path: Path, tables: dict[str, _Table]) -> Splats:
    """Read SuperSplat's compressed PLY, which stores chunks of 256 Gaussians."""
    import gsply

    if "min_r" not in [name for name, _ in tables["chunk"].columns]:
        raise UserError("an older SuperSplat wrote it: open it in the present one, and save it again")
    count, chunks = tables["vertex"].length, tables["chunk"].length
    expect(chunks == -(-count // 256), f"{count:,} Gaussians don't lie in {chunks:,} chunks")
    expect("sh" not in tables or tables["sh"].length == count, "its harmonics are of other Gaussians")
    check_memory(count, ALL_BANDS)
    return of_gsply(gsply.plyread(path))


def of_gsply(data: Any) -> Splats:
    """Build splats from what gsply read."""
    parts = [np.asarray(part) for part in (data.sh0, data.shN) if part is not None]
    bands = np.concatenate([part.reshape(len(data.means), -1, 3) for part in parts], axis=1)
    return activated(data.means, data.scales, data.quats, data.opacities, bands)


def encode_ply(splats: Splats, relevancy: Float[Tensor, " n"] | None = None) -> bytes:
    """Encode the layout of 3D Gaussian splatting, which ordinary splat viewers open, with the relevancy (0…1)
    as a further column."""
    harmonics, count = splats.harmonics, len(splats)
    blocks = {
        ("x", "y", "z"): splats.means,
        ("nx", "ny", "nz"): torch.zeros_like(splats.means),
        _numbered("f_dc", 3): harmonics[:, 0],
        # Viewers expect these coefficients channel by channel.
        _numbered("f_rest", 3 * (harmonics.shape[1] - 1)): harmonics[:, 1:].mT.reshape(count, -1),
        ("opacity",): logits(splats)[:, None],
        _numbered("scale", 3): log_scales(splats),
        _numbered("rot", 4): F.normalize(splats.quats, dim=1),
    }
    if relevancy is not None:
        blocks[("relevancy",)] = relevancy[:, None]
    names = [name for group in blocks for name in group]
    header = ["ply", "format binary_little_endian 1.0"]
    header += ["comment SplatRenderMode: mip", "comment antialiased 1"] if splats.antialiased else []
    header += [f"element vertex {count}", *(f"property float {name}" for name in names), "end_header", ""]
    table = np.concatenate([array_of(block) for block in blocks.values()], axis=1)
    return "\n".join(header).encode() + np.ascontiguousarray(table, dtype="<f4").tobytes()


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{i}" for i in range(count))
