"""SOG of version 2, PlayCanvas' compressed splats: a ZIP of lossless WebP pictures, a pixel per Gaussian."""

from __future__ import annotations

import io
import json
import zipfile
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float32, UInt8
from numpy import ndarray as Array
from PIL import Image

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.activations import ALL_BANDS, array_of, check_memory, log_scales, tensor_of
from lang3dxl_ns.rendering import Splats

_LARGEST = 252
"""Alpha of a rotation whose largest component is w; x, y and z follow."""
_COLUMNS = 64
"""Harmonics of the palette's entries in a row of its picture."""
_SAMPLE = 200_000
"""Most values that a codebook is chosen from."""


def encode_sog(splats: Splats) -> bytes:
    """Encode splats with one color each: harmonics above degree 0 are left out, which a message says."""
    if splats.degree:
        say(".sog is written with one color per Gaussian: write a .ply, .spz or .glb to keep the harmonics")
    means = array_of(splats.means).astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = (logs.min(0), logs.max(0)) if len(logs) else (np.zeros(3), np.ones(3))
    places = np.rint((logs - low) / np.maximum(high - low, 1e-12) * 65535).astype("<u2")
    scales, scale_book = _indexed(array_of(log_scales(splats)))
    colors, color_book = _indexed(array_of(splats.harmonics[:, 0]))
    opacities = np.rint(array_of(splats.opacities) * 255).clip(0, 255).astype(np.uint8)
    pictures = {
        "means_l.webp": (places & 255).astype(np.uint8),
        "means_u.webp": (places >> 8).astype(np.uint8),
        "scales.webp": scales,
        "quats.webp": _packed(array_of(F.normalize(splats.quats, dim=1))),
        "sh0.webp": np.column_stack([colors, opacities]),
    }
    about = {
        "version": 2,
        "count": len(splats),
        "antialias": splats.antialiased,
        **({"model": "antialiased"} if splats.antialiased else {}),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book, "files": ["sh0.webp"]},
    }
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", zipfile.ZIP_STORED) as bundle:
        bundle.writestr(_part("meta.json"), json.dumps(about))
        for name, values in pictures.items():
            bundle.writestr(_part(name), _picture(values))
    return written.getvalue()


def _part(name: str) -> zipfile.ZipInfo:
    """Describe a part without the time, since a ZIP can't hold that of a clock before 1980."""
    part = zipfile.ZipInfo(name)
    part.external_attr = 0o644 << 16
    return part


def _indexed(values: Float32[Array, "n 3"]) -> tuple[UInt8[Array, "n 3"], list[float]]:
    """Replace values by indices into 256 of them, half of which are spaced evenly and half by frequency."""
    flat = np.sort(values.ravel()[:: max(values.size // _SAMPLE, 1)])
    ends = np.linspace(values.min(initial=0), values.max(initial=0), 128)
    book = np.sort(np.concatenate([ends, np.quantile(flat, np.linspace(0, 1, 128))])) if len(flat) else ends
    book = book.astype(np.float32)
    found = np.searchsorted((book[1:] + book[:-1]) / 2, values)
    return found.astype(np.uint8), book.tolist()


def _packed(quats: Float32[Array, "n 4"]) -> UInt8[Array, "n 4"]:
    rows, largest = np.arange(len(quats)), np.abs(quats).argmax(1)
    signed = quats * np.where(quats[rows, largest] < 0, -1, 1)[:, None]
    others = signed[np.arange(4) != largest[:, None]].reshape(-1, 3)
    small = np.rint((others * sqrt(0.5) + 0.5) * 255).clip(0, 255)
    return np.column_stack([small, _LARGEST + largest]).astype(np.uint8)


def _picture(values: UInt8[Array, "n c"]) -> bytes:
    width = max(4 * ceil(sqrt(len(values)) / 4), 4)
    height = max(4 * ceil(len(values) / width / 4), 4)
    pixels = np.full((width * height, 4), 255, np.uint8)
    pixels[: len(values), : values.shape[1]] = values
    written = io.BytesIO()
    # Without `exact`, WebP would drop the colors of pixels whose alpha is 0.
    Image.fromarray(pixels.reshape(height, width, 4)).save(written, "WEBP", lossless=True, exact=True)
    return written.getvalue()


def read_sog(path: Path) -> Splats:
    """Read the Gaussians of a .sog bundle, with harmonics. Raises UserError for another version, and one of
    `DAMAGE` or DecompressionBombError for a damaged file."""
    with zipfile.ZipFile(path) as bundle:
        about: dict[str, Any] = json.loads(_member(bundle, "meta.json"))
        if about.get("version") != 2:
            raise UserError("its SOG version is not 2: convert it with splat-transform")
        count = about["count"]
        expect(isinstance(count, int) and count >= 0, "its number of Gaussians")
        check_memory(count, ALL_BANDS)
        low, high, scales, quats, first = (
            _pixels(bundle, name, count)
            for part in ("means", "scales", "quats", "sh0")
            for name in about[part]["files"]
        )
        mins, maxs = (np.array(about["means"][end], np.float64) for end in ("mins", "maxs"))
        logs = mins + (high[:, :3].astype(np.float64) * 256 + low[:, :3]) / 65535 * (maxs - mins)
        harmonics = _book(about["sh0"])[first[:, :3]][:, None]
        if "shN" in about:
            harmonics = np.concatenate([harmonics, _palette(bundle, about["shN"], count)], axis=1)
    return Splats(
        tensor_of(np.sign(logs) * np.expm1(np.abs(logs))),
        tensor_of(_unpacked(quats)),
        tensor_of(_book(about["scales"])[scales[:, :3]]).exp(),
        torch.from_numpy(first[:, 3] / np.float32(255)),
        tensor_of(harmonics[:, :ALL_BANDS]),
        bool(about.get("antialias", False)) or about.get("model") == "antialiased",
    )


def _palette(bundle: zipfile.ZipFile, about: dict[str, Any], count: int) -> Float32[Array, "n k 3"]:
    """Read the harmonics above degree 0, which Gaussians share."""
    bands = (about["bands"] + 1) ** 2 - 1
    expect(bands in (3, 8, 15), f"its harmonics have {about['bands']} bands")
    with _opened(bundle, about["files"][0]) as image:
        expect(image.width == _COLUMNS * bands, "its palette has another width")
        colors = np.asarray(image.convert("RGB")).reshape(-1, bands, 3)
    labels = _pixels(bundle, about["files"][1], count).astype(np.int64)
    chosen = labels[:, 0] + 256 * labels[:, 1]
    expect(not count or int(chosen.max()) < len(colors), "a color lies outside of its palette")
    return _book(about)[colors[chosen]]


def _book(about: dict[str, Any]) -> Float32[Array, "256"]:
    book = np.array(about["codebook"], np.float32)
    expect(book.shape == (256,), "a codebook has not 256 values")
    book[0] = book[1] if np.isnan(book[0]) else book[0]  # PlayCanvas' tools write null for what is lowest
    return book


def _unpacked(quats: UInt8[Array, "n 4"]) -> Float32[Array, "n 4"]:
    largest = quats[:, 3].astype(int) - _LARGEST
    expect(bool(((largest >= 0) & (largest < 4)).all()), "its rotations")
    parts = np.zeros((len(quats), 4), np.float32)
    small = (quats[:, :3] / np.float32(255) - 0.5) / np.float32(sqrt(0.5))
    parts[np.arange(4) != largest[:, None]] = small.ravel()
    parts[np.arange(len(parts)), largest] = np.sqrt(np.maximum(1 - (small**2).sum(1), 0))
    return parts


def _pixels(bundle: zipfile.ZipFile, name: str, count: int) -> UInt8[Array, "n 4"]:
    with _opened(bundle, name) as image:
        expect(count <= image.width * image.height <= 4 * count + 4096, f"{name} has another size")
        return np.asarray(image.convert("RGBA")).reshape(-1, 4)[:count]


def _opened(bundle: zipfile.ZipFile, name: str) -> Image.Image:
    # No other decoder, and no program that one starts (Ghostscript), sees a stranger's file.
    return Image.open(io.BytesIO(_member(bundle, name)), formats=("WEBP", "PNG"))


def _member(bundle: zipfile.ZipFile, name: str) -> bytes:
    # A small archive may unpack to any size.
    expect(bundle.getinfo(name).file_size <= 1000 * sum(i.compress_size for i in bundle.infolist()), name)
    return bundle.read(name)
