"""SPZ, Niantic's compressed splats: versions 1 to 3 in one gzip stream, and version 4 in zstd streams.

A Gaussian takes 8 bits per value, and 24 per coordinate. A file may hold records of vendors. Ours is a scene
file, which other readers skip.
"""

from __future__ import annotations

import gzip
import struct
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from io import BufferedIOBase, BytesIO
from math import exp, floor, log2
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch.nn.functional as F
from jaxtyping import Float32, UInt8
from numpy import ndarray as Array

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.activations import ALL_BANDS, array_of, check_memory, log_scales, tensor_of
from lang3dxl_ns.rendering import Splats

_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
"""Magic, version, number of Gaussians, degree, fractional bits of coordinates, flags, number of streams."""
_ANTIALIASED, _RECORDS = 1, 2
"""Bits of the flags."""
_RECORD, _SCENE = struct.Struct("<II"), 0x4C330001
"""Type and length of a record, and the type of ours: vendor "L3", record 1."""
_AXES = 0xADBE0003
"""Type of the record that names the directions of the axes."""
_ODD = [3, 4, 7, 10, 13, 15]
"""Harmonics that change their sign with x."""
_HIGHEST_DEGREE = 4


def read_spz(path: Path) -> Splats:
    """Read the Gaussians of a file of any version, as `decode_spz` does."""
    with path.open("rb") as file:
        return decode_spz(file)


def decode_spz(file: BinaryIO) -> Splats:
    """Decode the Gaussians of any version. No memory is allocated beyond what the header announces. Raises
    UserError for an unknown version or degree, and one of `DAMAGE` for a damaged file."""
    with _opened(file) as (stream, version, count, degree, bits, flags, streams):
        if degree > _HIGHEST_DEGREE:
            raise UserError(f"its harmonics have degree {degree}; 0 to 4 can be read: export it anew")
        expect(bits <= 24, f"its coordinates have {bits} fractional bits")
        expect(count > 0, "it holds no Gaussian")
        check_memory(count, ALL_BANDS)
        sides = _sides(version, degree)
        if version < 4:
            parts = [_exactly(stream, count * side) for side in sides]
            expect(bool(flags & _RECORDS) or not stream.read(1), _MORE)
        else:
            parts = _zstd_parts(stream.read(), [count * side for side in sides if side], streams)
        splats = _decoded(parts, count, version, bits, flags)
    return _mirrored(splats) if _left_handed(_record(file, _AXES)) else splats


def _left_handed(axes: bytes | None) -> bool:
    """Return whether a record names left-handed axes. Its number, less one, has a bit each for right (not
    left), up (not down) and forward (not back), and one for axes in the order x, z, y."""
    number = int.from_bytes(axes or b"", "little") - 1
    return 0 <= number < 16 and number.bit_count() % 2 == 1


def _mirrored(splats: Splats) -> Splats:
    """Mirror splats in x, which is told."""
    say("its axes are left-handed, so x is mirrored: elsewhere it has the other sign")
    bands = range(splats.harmonics.shape[1])
    harmonics = splats.harmonics * splats.means.new_tensor([[-1.0 if i in _ODD else 1.0] for i in bands])
    means, quats = (part * part.new_tensor(signs) for part, signs in (
        (splats.means, [-1.0, 1, 1]), (splats.quats, [1.0, 1, -1, -1])
    ))  # fmt: skip
    return replace(splats, means=means, quats=quats, harmonics=harmonics)


def scene_record(path: Path) -> bytes | None:
    """Read the scene file in a file; None if there is none. Raises what `read_spz` does."""
    with path.open("rb") as file:
        return _record(file, _SCENE)


def _record(file: BinaryIO, wanted: int) -> bytes | None:
    """Read the first record of a type; None if there is none."""
    largest = 100 * file.seek(0, 2)  # nothing that a scene holds packs so well
    with _opened(file) as (stream, version, count, degree, _, flags, _):
        if not flags & _RECORDS:
            return None
        if version < 4:  # records end the stream; in version 4 they follow the header of 32 bytes
            stream.seek(_HEADER.size + count * sum(_sides(version, degree)))
        else:
            start = struct.unpack("<I", _exactly(stream, 4))[0]
            stream = BytesIO(stream.read()[12 : max(start - 20, 12)])
        while len(head := stream.read(_RECORD.size)) == _RECORD.size:
            kind, size = _RECORD.unpack(head)
            expect(size <= largest, _MORE)
            content = _exactly(stream, size)
            if kind == wanted:
                return content
    return None


@contextmanager
def _opened(file: BinaryIO) -> Iterator[tuple[Any, ...]]:
    """Open a file of any version: its unpacked stream after the header, and the header's numbers."""
    file.seek(0)
    packed = file.read(2) == b"\x1f\x8b"
    file.seek(0)
    with gzip.open(file) if packed else nullcontext(file) as stream:
        head = stream.read(_HEADER.size)
        expect(len(head) == _HEADER.size, "its header is cut short")
        magic, version, *numbers = _HEADER.unpack(head)
        expect(magic == _MAGIC, "it doesn't begin like an SPZ")
        if not 1 <= version <= 4:
            raise UserError(f"it is SPZ of version {version}; 1 to 4 can be read: save it as one of them")
        yield stream, version, *numbers


_MORE = "it unpacks to more than its header announces"


def _sides(version: int, degree: int) -> list[int]:
    """Return the bytes per Gaussian of places, opacities, colors, scales, rotations and harmonics."""
    return [6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1)]


def _exactly(stream: BufferedIOBase, size: int) -> bytes:
    content = stream.read(size)
    expect(len(content) == size, "it holds less than its header announces")
    return content


def _zstd_parts(after: bytes, sizes: list[int], streams: int) -> list[bytes]:
    """Unpack version 4, whose bytes `after` the header hold vendors' records, which are skipped, and
    streams of these sizes."""
    try:
        import zstandard
    except ImportError as error:
        raise UserError("SPZ of version 4 needs zstandard: pip install -e '.[share]'") from error
    content = bytes(_HEADER.size) + after
    start = struct.unpack_from("<I", content, _HEADER.size)[0]
    expect(streams == len(sizes), f"it has {streams} streams, not {len(sizes)}")
    place, parts = start + 16 * streams, []
    for i, size in enumerate(sizes):
        packed = struct.unpack_from("<Q", content, start + 16 * i)[0]
        expect(packed <= len(content) - place, "it is cut short")
        try:
            reader = zstandard.ZstdDecompressor().stream_reader(content[place : place + packed])
            part = reader.read(size + 1)  # a small file may unpack to any size
        except zstandard.ZstdError as error:
            raise ValueError(error) from error
        expect(len(part) <= size, _MORE)
        expect(len(part) == size, "it holds less than its header announces")
        parts.append(part)
        place += packed
    return parts


def _decoded(parts: list[bytes], count: int, version: int, bits: int, flags: int) -> Splats:
    rows = [np.frombuffer(part, np.uint8).reshape(count, -1) for part in parts]
    places, alphas, colors, scales, turns, *others = rows
    if version == 1:
        means = places.view("<f2").astype(np.float32)
    else:
        wide = np.concatenate([np.zeros((count, 3, 1), np.uint8), places.reshape(count, 3, 3)], axis=2)
        means = (wide.view("<i4")[..., 0] >> 8).astype(np.float32) * np.float32(2.0**-bits)
    harmonics = ((colors / np.float32(255) - 0.5) / 0.15)[:, None]
    if others:
        rest = (others[0].reshape(count, -1, 3).astype(np.float32) - 128) / 128
        harmonics = np.concatenate([harmonics, rest[:, : ALL_BANDS - 1]], axis=1)
    quats = _quats(turns) if version < 3 else _quats_of_three(turns)
    return Splats(
        tensor_of(means), tensor_of(quats), tensor_of(scales / np.float32(16) - 10).exp(),
        tensor_of(alphas[:, 0] / np.float32(255)), tensor_of(harmonics), bool(flags & _ANTIALIASED),
    )  # fmt: skip


def _quats(turns: UInt8[Array, "n 3"]) -> Float32[Array, "n 4"]:
    """Decode x, y and z of unit quaternions whose w is positive."""
    axes = turns / np.float32(127.5) - 1
    return np.column_stack([np.sqrt(np.maximum(1 - (axes**2).sum(1), 0)), axes])


def _quats_of_three(turns: UInt8[Array, "n 4"]) -> Float32[Array, "n 4"]:
    """Decode the three smallest of x, y, z, w, 10 bits each, the last lowest, below the largest's index."""
    word = turns.view("<u4")[:, 0]
    largest = word >> 30
    parts = np.zeros((len(word), 4), np.float32)
    for axis in (3, 2, 1, 0):
        size = (word & 511) * np.float32(0.5**0.5 / 511)
        signed, kept = np.where(word & 512, -size, size), largest != axis
        parts[kept, axis] = signed[kept]
        word = np.where(kept, word >> 10, word)
    rest = np.sqrt(np.maximum(1 - (parts**2).sum(1), 0))
    parts[np.arange(len(parts)), largest] = rest
    return np.roll(parts, 1, axis=1)


def fractional_bits(splats: Splats) -> int:
    """Return how many bits after the point coordinates have. Raises UserError for those too large for 24 bits
    in all."""
    farthest = float(splats.means.abs().max()) if len(splats) else 0.0
    bits = min(floor(22 - log2(max(farthest, 1e-3))), 20)
    if bits < 0:
        raise UserError(
            f".spz holds coordinates up to 4 million, and these reach {farthest:,.0f}: write a .ply"
        )
    return bits


def encode_spz(splats: Splats, record: bytes | None = None) -> bytes:
    """Encode version 3. record: content of the scene's file. Says what is rounded or cut so much that it
    shows. Raises UserError as `fractional_bits`."""
    bits, largest, sizes = fractional_bits(splats), exp(255 / 16 - 10), splats.scales.amax(1)
    if len(splats) and 4 * 2.0**-bits > (usual := float(sizes.median())):
        say(
            f".spz rounds places to {2.0**-bits:.2g} units because one Gaussian is far away, and half of all "
            f"are smaller than {usual:.2g}: leave far ones out (export --hide-floaters), or write a .ply"
        )
    if large := int((sizes > largest).sum()):
        say(f".spz holds sizes up to {largest:.0f} units: {large:,} larger Gaussians are cut to that")
    flags = _ANTIALIASED * splats.antialiased + _RECORDS * (record is not None)
    head = _HEADER.pack(_MAGIC, 3, len(splats), splats.degree, bits, flags, 0)
    last = b"" if record is None else _RECORD.pack(_SCENE, len(record)) + record
    return gzip.compress(head + b"".join(_encoded(splats, bits)) + last)


def _encoded(splats: Splats, bits: int) -> Iterator[bytes]:
    fixed = np.round(array_of(splats.means).astype(np.float64) * 2**bits).astype("<i4")
    yield fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    harmonics = splats.harmonics
    for values in (
        splats.opacities * 255, harmonics[:, 0] * 0.15 * 255 + 127.5, (log_scales(splats) + 10) * 16
    ):  # fmt: skip
        yield _bytes(array_of(values))
    yield _three_of(array_of(F.normalize(splats.quats, dim=1))).tobytes()
    yield _bytes(array_of(harmonics[:, 1:] * 128 + 128))


def _bytes(values: Float32[Array, "..."]) -> bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()


def _three_of(quats: Float32[Array, "n 4"]) -> UInt8[Array, "n 4"]:
    """Encode unit quaternions (w first) for `_quats_of_three`."""
    parts = np.roll(quats, -1, axis=1)
    largest = np.abs(parts).argmax(1)
    parts = parts * np.where(parts[np.arange(len(parts)), largest] < 0, -1, 1)[:, None]
    word = largest.astype("<u4")
    for axis in range(4):
        size = np.minimum(np.round(np.abs(parts[:, axis]) * 511 * 2**0.5), 511).astype("<u4")
        word = np.where(largest != axis, word << 10 | (parts[:, axis] < 0) * np.uint32(512) | size, word)
    return word.astype("<u4").view(np.uint8).reshape(-1, 4)
