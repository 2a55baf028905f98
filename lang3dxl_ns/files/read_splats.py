"""Splats of other programs: PLY of any kind, SPZ, .splat, checkpoints of gsplat and nerfstudio.

Sizes are compared with the file's before anything of that size is allocated. No code in a file is executed.
"""

from __future__ import annotations

import gzip
import pickle
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import replace
from io import BytesIO
from math import isqrt
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import is_zipfile

import numpy as np
import torch
from jaxtyping import Float, Float32
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import DAMAGE, UserError, in_a_line, not_of_memory
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.rendering import Splats, harmonics_of

KINDS = ".ply, .spz, .splat, a checkpoint of gsplat (.pt) or nerfstudio (.ckpt), or a run's folder"
_IN_FOLDERS = ("*.ckpt", "nerfstudio_models/*.ckpt", "ckpts/*.pt", "point_cloud/iteration_*/point_cloud.ply")
"""Patterns of the files in which programs leave splats in a run's folder."""
_MOST_DAMAGE = 0.5
"""Share of Gaussians with NaN or infinite values above which a file is refused."""
_HEADER = 1 << 16
"""Most bytes that the header of a PLY may take."""
_ALL_BANDS = 16
"""Number of harmonics up to degree 3; those of higher degrees are dropped."""


def find_splats(path: str | Path) -> Path:
    """Find a splat: the path itself, or the latest file in a run's folder. Raises UserError without one."""
    path = expanded(path)
    if path.is_file():
        return path
    if not path.is_dir():
        raise UserError(f"{path} does not exist: name a splat ({KINDS})")
    found = [file for pattern in _IN_FOLDERS for file in path.glob(pattern)]
    if not found:
        raise UserError(f"{path} holds no splat: name one ({KINDS})")
    digits = {file: re.findall(r"\d+", str(Path(*file.parts[-2:]))) for file in found}
    return max(found, key=lambda file: (max(map(int, digits[file]), default=0), file.name))


def read_splats(path: str | Path) -> Splats:
    """Read all Gaussians of a file, in the file's order.

    Gaussians with NaN or infinite values keep their place, but lose their size and opacity.

    Args:
        path: .ply (as 3D Gaussian splatting writes it, or compressed by SuperSplat), .spz, .splat, a gsplat
            checkpoint (.pt), a splatfacto checkpoint (.ckpt), or the folder of a run with one of them.

    Raises:
        UserError: there is no such file, or it is damaged, cut short, too large for this machine, of another
            kind, or most of its values are not finite.
    """
    path = find_splats(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"{path.name} names no kind of splat: give {KINDS}")
    try:
        # gsplat on several GPUs leaves a file of each (ckpt_6999_rank1.pt).
        ranks = re.fullmatch(r"(ckpt_\d+_rank)\d+\.pt", path.name)
        files = sorted(path.parent.glob(f"{ranks[1]}*.pt")) if ranks else [path]
        splats = _joined([reader(file) for file in files])
    except ImportError as error:
        raise UserError(f"{path.suffix} files need gsply: pip install 'lang3dxl-ns[share]'") from error
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except DAMAGE as error:
        not_of_memory(error)
        reason = in_a_line(error)
        raise UserError(f"{path} is damaged or incomplete ({reason}): copy or export it again") from error
    return _finite(splats, path)


def _joined(parts: list[Splats]) -> Splats:
    """Join Gaussians of several files, in their order."""
    names = ("means", "quats", "scales", "opacities", "harmonics")
    joined: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    return replace(parts[0], **joined)


def _finite(splats: Splats, path: Path) -> Splats:
    """Return the same Gaussians, with those that have NaN or infinite values made invisible."""
    if not len(splats):
        raise UserError(f"{path} holds no Gaussian: export it again")
    sound = splats.sound() & (splats.means.abs() < 1e9).all(1) & (splats.scales >= 0).all(1)
    if sound.all():
        return splats
    share = 1 - float(sound.float().mean())
    if share > _MOST_DAMAGE:
        raise UserError(f"{path}: {share:.0%} of its Gaussians have NaN or infinite values; export it again")
    say(f"{path}: {share:.2%} of its Gaussians have NaN or infinite values; they are left invisible")
    place = splats.means[sound].median(0).values
    keep = sound[:, None]
    return replace(
        splats,
        means=torch.where(keep, splats.means, place),
        quats=torch.where(keep, splats.quats, 0.0),
        scales=torch.where(keep, splats.scales, 1e-9),
        opacities=torch.where(sound, splats.opacities, 0.0),
        harmonics=torch.where(keep[..., None], splats.harmonics, 0.0),
    )


def _check_memory(count: int, bands: int) -> None:
    """Raise UserError if Gaussians don't fit into memory when they are read and activated."""
    needed, there = 3 * 4 * count * (11 + 3 * bands), machine_memory()
    if needed > there:
        raise UserError(
            f"{count:,} Gaussians need {needed / 1e9:.0f} GB of memory, and this machine has "
            f"{there / 1e9:.0f}: prune the splat (SuperSplat does), or use a larger machine"
        )


def _activated(
    means: Any, log_scales: Any, quats: Any, logits: Any, harmonics: Any, antialiased: bool = False
) -> Splats:
    """Build splats from stored values: logarithms of scales, logits of opacities, harmonics [n, k, 3]."""
    means, log_scales, quats, logits, harmonics = map(_tensor, (means, log_scales, quats, logits, harmonics))
    bands = harmonics.shape[1]
    expect(isqrt(bands) ** 2 == bands, f"it has {bands} harmonics per color")
    sides = [part.shape[-1] for part in (means, log_scales, quats, harmonics)]
    expect(sides == [3, 3, 4, 3], f"its parts have {sides} numbers a Gaussian")
    opacities, harmonics = logits.reshape(-1).sigmoid(), harmonics[:, :_ALL_BANDS].contiguous()
    return Splats(means, quats, log_scales.exp(), opacities, harmonics, antialiased)


def _tensor(values: Any) -> Float[Tensor, "n ..."]:
    tensor = values if isinstance(values, Tensor) else torch.from_numpy(np.ascontiguousarray(values))
    return tensor.detach().float()


# ── PLY ─────────────────────────────────────────────────────────────────────────────────────────────────


_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_NEEDED = ("x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3")
_Tables = dict[str, tuple[int, "np.dtype[Any]"]]
"""Length and row type of each table of a PLY, by its name, in the file's order."""


def _ply(path: Path) -> Splats:
    with path.open("rb") as file:
        form, tables = _ply_header(file)
        count, row = tables.get("vertex", (0, np.dtype([])))
        columns = row.names or ()
        if form != "ascii":
            announced = sum(length * kind.itemsize for length, kind in tables.values())
            expect(announced <= path.stat().st_size - file.tell(), "it announces more than it holds")
        if "chunk" in tables and "packed_position" in columns:
            return _supersplat(path, tables)
        if missing := [name for name in _NEEDED if name not in columns]:
            raise UserError(f"not a splat but a point cloud: its points have no {', '.join(missing[:3])}")
        expect(next(iter(tables)) == "vertex", "its points don't come first")
        expect(all(row[name].itemsize for name in columns), "its points hold lists")
        _check_memory(count, 1 + sum(name.startswith("f_rest_") for name in columns) // 3)
        if form != "ascii":
            return _of_table(np.fromfile(file, row, count))
        numbers = np.fromstring(file.read().decode("latin-1"), sep=" ", dtype=np.float32)
        expected = count * len(columns)
        expect(len(numbers) == expected or len(tables) > 1, f"it has {len(numbers)} numbers, not {expected}")
        rows = numbers[:expected].reshape(count, len(columns))
        return _of_table({name: rows[:, i] for i, name in enumerate(columns)})


def _ply_header(file: BinaryIO) -> tuple[str, _Tables]:
    """Read the format and the tables of a PLY, and leave the file at the first table's data."""
    head = file.read(_HEADER)
    expect(head.startswith(b"ply"), "it doesn't begin like a PLY")
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if end is None:
        raise ValueError("its header doesn't end")
    form, order, listed = "", "<", dict[str, tuple[int, list[tuple[str, str]]]]()
    columns: list[tuple[str, str]] = []
    for line in head[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", form, *_]:
                order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
            case ["element", name, count]:
                expect(name not in listed and int(count) >= 0, f"it lists {name} twice, or less than none")
                columns = []
                listed[name] = (int(count), columns)
            case ["property", "list", *_, column]:
                columns.append((column, "V0"))  # lists follow the vertices in meshes, and are never read
            case ["property", kind, column]:
                columns.append((column, order + _PLY_TYPES[kind]))
    file.seek(end.end())
    return form, {name: (count, np.dtype(columns)) for name, (count, columns) in listed.items()}


def _of_table(table: Any) -> Splats:
    """Build splats from the columns that 3D Gaussian splatting writes."""

    def columns(*names: str) -> Float[Tensor, "n k"]:
        return torch.from_numpy(np.stack([table[name].astype(np.float32) for name in names], axis=1))

    known = table.dtype.names if isinstance(table, np.ndarray) else tuple(table)
    rest = sorted(filter(re.compile(r"f_rest_\d+").fullmatch, known), key=lambda name: int(name[7:]))
    if "f_dc_0" in known:
        first = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    else:
        colors = columns("red", "green", "blue")  # 0 to 255, or 0 to 1
        first = harmonics_of(colors / (255 if (colors > 1).any() else 1))
    # Coefficients are stored channel by channel.
    others = columns(*rest).reshape(len(first), 3, len(rest) // 3).mT if rest else first[:, :0]
    scales = columns("scale_0", "scale_1")
    # A flat Gaussian (2D Gaussian splatting) has only two scales.
    third = columns("scale_2") if "scale_2" in known else scales.amin(1, keepdim=True) - 5
    quats, scales = columns("rot_0", "rot_1", "rot_2", "rot_3"), torch.cat([scales, third], dim=1)
    harmonics = torch.cat([first, others], dim=1)
    return _activated(columns("x", "y", "z"), scales, quats, columns("opacity"), harmonics)


def _supersplat(path: Path, tables: _Tables) -> Splats:
    """Read SuperSplat's compressed PLY, which stores chunks of 256 Gaussians."""
    import gsply

    if "min_r" not in (tables["chunk"][1].names or ()):
        raise UserError("an older SuperSplat wrote it: open it in the present one, and save it again")
    count, chunks = tables["vertex"][0], tables["chunk"][0]
    expect(chunks == -(-count // 256), f"{count:,} Gaussians don't lie in {chunks:,} chunks")
    expect(tables.get("sh", (count,))[0] == count, "its harmonics are of other Gaussians")
    _check_memory(count, _ALL_BANDS)
    return _of_gsply(gsply.plyread(path))


def _of_gsply(data: Any) -> Splats:
    parts = [np.asarray(part) for part in (data.sh0, data.shN) if part is not None]
    bands = np.concatenate([part.reshape(len(data.means), -1, 3) for part in parts], axis=1)
    return _activated(data.means, data.scales, data.quats, data.opacities, bands)


# ── other files ─────────────────────────────────────────────────────────────────────────────────────────


def _spz(path: Path) -> Splats:
    """Read Niantic's compressed format: one gzip stream up to version 3, zstd streams in version 4."""
    import gsply
    import zstandard

    content = path.read_bytes()
    packed = content[:2] == b"\x1f\x8b"
    try:
        with gzip.open(path) if packed else BytesIO(content) as stream:
            _, _, count, degree, _, flags, parts = struct.unpack("<IIIBBBB", stream.read(16))
            _check_memory(count, _ALL_BANDS)
            most = 20 * count + 3 * 15 * count + (1 << 20)
            # A small file may unpack to any size.
            size = len(stream.read(most)) if packed else _largest_part(memoryview(content), parts)
            expect(degree <= 3 and size < most, "it unpacks to more than its header announces")
        return replace(_of_gsply(gsply.read_spz(path)), antialiased=bool(flags & 1))
    except zstandard.ZstdError as error:
        raise ValueError(error) from error


def _largest_part(content: memoryview, parts: int) -> int:
    """Return the largest size that a zstd stream of an .spz file announces. gsply limits those that announce
    none."""
    import zstandard

    table = struct.unpack_from("<I", content, 16)[0]
    place, largest = table + 16 * parts, 0
    for i in range(parts):
        largest = max(largest, zstandard.frame_content_size(content[place:]))
        place += struct.unpack_from("<Q", content, table + 16 * i)[0]
    return largest


_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


def _splat(path: Path) -> Splats:
    """Read the format of the first web viewers: 32 bytes per Gaussian, with one color."""
    size = path.stat().st_size
    expect(size % _SPLAT.itemsize == 0, f"{size} bytes are not whole Gaussians of {_SPLAT.itemsize} bytes")
    _check_memory(size // _SPLAT.itemsize, 1)
    table = np.fromfile(path, _SPLAT)
    colors = torch.from_numpy(table["color"].astype(np.float32) / 255)
    quats: Float32[Array, "n 4"] = (table["quat"].astype(np.float32) - 128) / 128
    means, scales = _tensor(table["mean"]), _tensor(table["scale"])
    return Splats(means, _tensor(quats), scales, colors[:, 3], harmonics_of(colors[:, :3]))


class _NumPyScalar:
    """Placeholder for NumPy's scalars in pickles, such as a trainer's learning rates; it takes anything."""

    def __init__(self, *_: Any) -> None: ...

    def __setstate__(self, _: Any) -> None: ...


_SCALARS = (
    *("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar", "numpy.dtype"),
    "_codecs.encode",  # makes their bytes, in the pickles that torch.save writes
)
"""Names in pickles that `_NumPyScalar` replaces."""


def _checkpoint(path: Path) -> Splats:
    if not is_zipfile(path):
        raise UserError("it is not a checkpoint of torch 1.6 or later: save it again with a newer torch")
    try:
        with torch.serialization.safe_globals([(_NumPyScalar, name) for name in _SCALARS]):
            state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        raise ValueError("it holds more than tensors, or is no checkpoint; nothing in it was run") from error
    parts = state if isinstance(state, dict) else {}
    if isinstance(parts.get("pipeline"), dict):
        return _splatfacto(parts["pipeline"], path)
    if isinstance(parts.get("splats"), dict):
        return _gsplat(parts["splats"])
    raise UserError("it is a checkpoint of another program than gsplat and nerfstudio")


def _gsplat(parts: Mapping[str, Any]) -> Splats:
    """Build splats from what gsplat's example trainers save."""
    _check_parts(parts, ("means", "scales", "quats", "opacities"))
    if "sh0" not in parts:
        raise UserError("a network makes its colors (app_opt): train it without, or export a PLY")
    harmonics = torch.cat([parts["sh0"], parts["shN"]], dim=1)
    return _activated(parts["means"], parts["scales"], parts["quats"], parts["opacities"], harmonics)


def _splatfacto(pipeline: Mapping[str, Any], path: Path) -> Splats:
    """Build splats from nerfstudio's splatfacto of any version; older ones call the means _model.means."""
    names = {name: re.fullmatch(r"_model\.(?:gauss_params\.)?([^.]+)", name) for name in pipeline}
    own = {found[1]: pipeline[name] for name, found in names.items() if found}
    _check_parts(own, ("means", "scales", "quats", "opacities", "features_dc", "features_rest"))
    first, rest = own["features_dc"].float().reshape(-1, 1, 3), own["features_rest"].float()
    if not rest.shape[1]:  # the colors themselves, as logits
        first = harmonics_of(first[:, 0].sigmoid())
    config = path.parent.parent / "config.yml"
    antialiased = config.is_file() and "rasterize_mode: antialiased" in config.read_text(errors="replace")
    harmonics = torch.cat([first, rest.reshape(len(first), -1, 3)], dim=1)
    return _activated(own["means"], own["scales"], own["quats"], own["opacities"], harmonics, antialiased)


def _check_parts(parts: Mapping[str, Any], names: tuple[str, ...]) -> None:
    missing = [name for name in names if not isinstance(parts.get(name), Tensor)]
    if missing:
        raise UserError(f"it is not a splat: it has no {', '.join(missing)}")
    count = len(parts["means"])
    for name, value in parts.items():
        expect(name not in names or len(value) == count, f"{name} are not as many as means")
        if isinstance(value, Tensor):
            stored = value.untyped_storage().nbytes()
            expect(value.nbytes <= stored, f"{name} is larger than what is stored of it")
    _check_memory(count, _ALL_BANDS)


_READERS: dict[str, Callable[[Path], Splats]] = {
    **{".ply": _ply, ".spz": _spz, ".splat": _splat},
    **{".pt": _checkpoint, ".pth": _checkpoint, ".ckpt": _checkpoint},
}
