"""GLB, glTF's binary form, with splats (KHR_gaussian_splatting) and, if asked for, things or the scene.

A scene's record is a scene file in a buffer view of its own, which other readers skip.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator, Sequence
from io import BytesIO
from math import isqrt
from pathlib import Path
from typing import Any

import numpy as np
import torch.nn.functional as F
from jaxtyping import Float, Float32, Shaped
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.activations import ALL_BANDS, array_of, check_memory, tensor_of
from lang3dxl_ns.files.spz import decode_spz
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.scene.georeference import Georeference
from lang3dxl_ns.things.thing import Thing

_SPLATS, _RECORD = "KHR_gaussian_splatting", "LANG3DXL_scene"
_SPZ = "KHR_gaussian_splatting_compression_spz"  # _2 and what follows: drafts, so they are read alone
_FEATURES, _METADATA = "EXT_mesh_features", "EXT_structural_metadata"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_FLOAT, _POINTS, _ARRAY_BUFFER = 5126, 0, 34962
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_SIDES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MOST_DEGREE = 3


def encode_glb(
    splats: Splats,
    record: bytes | None = None,
    codes: Float[Tensor, "n d"] | None = None,
    things: Sequence[Thing] = (),
    place: Georeference | None = None,
) -> bytes:
    """Encode the splats whose values are finite, in their own frame and units, with a scene file's content.

    codes: finite semantic numbers, 1 to 4 a Gaussian, for the attribute `_CODE`. things: each word becomes a
    set of feature ids, which are rows of one table of words, boxes and scores. place: meters, up and north,
    by which the node is placed as glTF wants it: y up, z to the south."""
    file, sound = _Writer(), splats.sound()
    named = {name: file.attribute(values) for name, values in _attributes(splats.select(sound))}
    if codes is not None and codes.shape[1] in _SIDES.values():
        named["_CODE"] = file.attribute(array_of(codes[sound]))
    local: dict[str, Any] = {_SPLATS: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    shared = dict[str, Any]()
    if things:
        features = list(_feature_sets(things, len(splats)))
        for number, (ids, _) in enumerate(features):
            named[f"_FEATURE_ID_{number}"] = file.attribute(ids[sound.cpu().numpy()])
        local[_FEATURES] = {"featureIds": [described for _, described in features]}
        shared[_METADATA] = _table(file, things)
    if record is not None:
        shared[_RECORD] = {"bufferView": file.view(record)}
    node: dict[str, Any] = {"mesh": 0}
    if place is not None:
        axes = np.array([np.cross(place.north, place.up), place.up, np.negative(place.north)])
        node["matrix"] = [*np.pad(place.meters * axes.T, (0, 1)).ravel().tolist()[:-1], 1.0]
    extras = {"antialiased": splats.antialiased}
    primitive = {"mode": _POINTS, "attributes": named, "extensions": local, "extras": extras}
    file.content += bytes(-len(file.content) % 4)
    described: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "lang3dxl-ns"},
        "extensionsUsed": [*local, *shared],
        **({"extensions": shared} if shared else {}),
        **{"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node], "meshes": [{"primitives": [primitive]}]},
        **{"accessors": file.accessors, "bufferViews": file.views},
        "buffers": [{"byteLength": len(file.content)}],
    }
    text = json.dumps(described, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = _HEADER.size + 2 * _CHUNK.size + len(text) + len(file.content)
    if size >= 2**32:
        raise UserError(f"a .glb holds 4 GB, and these {len(splats):,} Gaussians need more: write a .ply")
    chunks = _CHUNK.pack(len(text), b"JSON"), text, _CHUNK.pack(len(file.content), b"BIN\0"), file.content
    return _HEADER.pack(b"glTF", 2, size) + b"".join(chunks)


class _Writer:
    """Binary part of a file in the making, its views, and accessors of them."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views, self.accessors = list[dict[str, Any]](), list[dict[str, Any]]()

    def view(self, content: bytes, **more: int) -> int:
        """Append bytes and return the number of their view."""
        self.content += bytes(-len(self.content) % 8)  # the alignment of metadata
        place = {"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content)}
        self.views.append(place | more)
        self.content += content
        return len(self.views) - 1

    def attribute(self, values: Float32[Array, "n ..."]) -> int:
        """Append a number or a vector of each Gaussian, and return the number of the accessor."""
        rows = values.astype("<f4").reshape(len(values), -1)
        kind = next(kind for kind, side in _SIDES.items() if side == rows.shape[1])
        accessor = {"bufferView": self.view(rows.tobytes(), target=_ARRAY_BUFFER), "componentType": _FLOAT}
        ends = {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor | ends | {"count": len(rows), "type": kind})
        return len(self.accessors) - 1


def _feature_sets(
    things: Sequence[Thing], count: int
) -> Iterator[tuple[Float32[Array, " n"], dict[str, Any]]]:
    """Yield for each word the feature ids of the Gaussians, rows of `_table`, and what tells of them."""
    ids = {thing.word: np.full(count, len(things), np.float32) for thing in things}
    for i in np.argsort([-thing.size.prod() for thing in things]):  # small ones over large ones
        ids[things[i].word][things[i].rows] = i
    for number, (word, rows) in enumerate(ids.items()):
        label = re.sub(r"\W", "_", f"_{word}", flags=re.ASCII)
        told = {"featureCount": len(np.unique(rows[rows < len(things)])), "nullFeatureId": len(things)}
        yield rows, {**told, "attribute": number, "propertyTable": 0, "label": label}


def _table(file: _Writer, things: Sequence[Thing]) -> dict[str, Any]:
    """Append what is known of things, and describe it as the one table of EXT_structural_metadata."""
    words = [thing.word.encode() for thing in things]
    offsets = file.view(np.cumsum([0, *map(len, words)]).astype("<u4").tobytes())
    kinds: dict[str, Any] = {"word": {"type": "STRING"}}
    columns: dict[str, Any] = {"word": {"values": file.view(b"".join(words)), "stringOffsets": offsets}}
    for name, kind in {"id": "SCALAR", "score": "SCALAR", "center": "VEC3", "size": "VEC3"}.items():
        values = np.array([getattr(thing, name) for thing in things], "<u4" if name == "id" else "<f4")
        kinds[name] = {"type": kind, "componentType": "UINT32" if name == "id" else "FLOAT32"}
        columns[name] = {"values": file.view(values.tobytes())}
    schema = {"id": "lang3dxl", "classes": {"thing": {"properties": kinds}}}
    table = {"class": "thing", "count": len(things), "properties": columns}
    return {"schema": schema, "propertyTables": [table]}


def _attributes(splats: Splats) -> Iterator[tuple[str, Float32[Array, "n ..."]]]:
    yield "POSITION", array_of(splats.means)
    yield f"{_SPLATS}:ROTATION", np.roll(array_of(F.normalize(splats.quats, dim=1)), -1, axis=1)
    yield f"{_SPLATS}:SCALE", array_of(splats.scales)
    yield f"{_SPLATS}:OPACITY", array_of(splats.opacities.clamp(0, 1))
    for band in range(splats.harmonics.shape[1]):
        yield _harmonic(band), array_of(splats.harmonics[:, band])


def _harmonic(band: int) -> str:
    degree = isqrt(band)
    return f"{_SPLATS}:SH_DEGREE_{degree}_COEF_{band - degree**2}"


class _Glb:
    """Content of a file: its description, and its binary part."""

    def __init__(self, path: Path) -> None:
        content = path.read_bytes()
        expect(len(content) >= _HEADER.size + _CHUNK.size, "it is cut short")
        magic, version, size = _HEADER.unpack_from(content)
        expect(magic == b"glTF" and version == 2, "it doesn't begin like a GLB of version 2")
        expect(size <= len(content), "it is cut short")
        chunks, place = dict[bytes, memoryview](), _HEADER.size
        while place + _CHUNK.size <= size:
            length, kind = _CHUNK.unpack_from(content, place)
            place += _CHUNK.size
            expect(length <= size - place, "it is cut short")
            chunks.setdefault(kind, memoryview(content)[place : place + length])
            place += length
        self.binary = chunks.get(b"BIN\0", memoryview(b""))
        self.about: dict[str, Any] = json.loads(bytes(chunks[b"JSON"]))

    def view(self, number: int, row: int | None = None) -> memoryview:
        """Return the bytes of a buffer view, of which each `row` follows the one before."""
        view = self.about["bufferViews"][number]
        start, size = view.get("byteOffset", 0), view["byteLength"]
        inside = isinstance(start, int) and isinstance(size, int) and 0 <= start <= start + size
        expect(inside and start + size <= len(self.binary), "a part lies outside of it")
        whole = view["buffer"] == 0 and view.get("byteStride", row) == row
        expect(whole, "its parts are interleaved, or other files")
        return self.binary[start : start + size]

    def values(self, number: int, side: int) -> Float32[Array, "n side"]:
        """Return the values of an accessor, `side` of them a row."""
        accessor = self.about["accessors"][number]
        kind, count = _KINDS[accessor["componentType"]], accessor["count"]
        offset = accessor.get("byteOffset", 0)
        expect(_SIDES[accessor["type"]] == side and "sparse" not in accessor, "an attribute has another form")
        row = side * np.dtype(kind).itemsize
        content, size = self.view(accessor["bufferView"], row), count * row
        expect(0 <= offset <= offset + size <= len(content), "an attribute is cut short")
        values: Shaped[Array, " m"] = np.frombuffer(content[offset : offset + size], kind)
        largest = np.iinfo(values.dtype).max if accessor.get("normalized") else 1
        return (values.astype(np.float32) / np.float32(largest)).reshape(count, side)


def read_glb(path: Path) -> Splats:
    """Read the first splats of a file, in the frame of their own node. Raises UserError if it has none, or
    they are compressed otherwise than as SPZ, and one of `DAMAGE` for a damaged file."""
    file = _Glb(path)
    meshes = (primitive for mesh in file.about.get("meshes", []) for primitive in mesh["primitives"])
    splats = [one for one in meshes if _SPLATS in one.get("extensions", {})]
    if not splats:
        raise UserError(f"it holds no splats ({_SPLATS}): export it as a splat")
    if len(splats) > 1:
        say(f"{path} holds {len(splats)} splats, of which the first is read: join them in a splat editor")
    found = splats[0]
    named = found["attributes"]
    if str(found["extensions"][_SPLATS].get("colorSpace")).startswith("lin"):
        say(f"{path} has linear colors, which are shown too dark: convert them to srgb_rec709_display")
    for name, about in (found["extensions"][_SPLATS].get("extensions") or {}).items():
        if not name.startswith(_SPZ):
            raise UserError(f"its splats are compressed by {name}: export them without compression")
        return decode_spz(BytesIO(file.view(about["bufferView"])))
    if f"{_SPLATS}:SCALE" not in named or _harmonic(0) not in named:
        raise UserError(f"its attributes are those of points, or of a draft of {_SPLATS}: export it anew")
    degree = max(d for d in range(_MOST_DEGREE + 1) if _harmonic(d**2) in named)
    check_memory(file.about["accessors"][named["POSITION"]]["count"], ALL_BANDS)
    means, scales = (tensor_of(file.values(named[name], 3)) for name in ("POSITION", f"{_SPLATS}:SCALE"))
    quats = np.roll(file.values(named[f"{_SPLATS}:ROTATION"], 4), 1, axis=1)
    opacities = file.values(named[f"{_SPLATS}:OPACITY"], 1)[:, 0]
    bands = [file.values(named[_harmonic(band)], 3) for band in range((degree + 1) ** 2)]
    harmonics = np.stack(bands, axis=1)
    sizes = {len(means), len(quats), len(scales), len(opacities), len(harmonics)}
    expect(len(sizes) == 1, "its attributes differ in size")
    antialiased = bool((found.get("extras") or {}).get("antialiased", False))
    scales = scales.exp() if (scales < 0).any() else scales  # splat-transform wrote logarithms until 2026
    return Splats(means, tensor_of(quats), scales, tensor_of(opacities), tensor_of(harmonics), antialiased)


def scene_record(path: Path) -> bytes | None:
    """Read the scene file in a file; None if there is none. Raises one of `DAMAGE` for a damaged file."""
    file = _Glb(path)
    record = file.about.get("extensions", {}).get(_RECORD)
    return None if record is None else bytes(file.view(record["bufferView"]))
