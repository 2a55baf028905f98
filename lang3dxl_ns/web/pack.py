"""Compact binary forms of a scene's parts for the page: splats, codes, the field, words and views.

Numbers are little-endian. docs/share.md lists the files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.hash_grid import HASH_PRIMES
from lang3dxl_ns.components.semantic_field import SemanticField
from lang3dxl_ns.files.activations import array_of
from lang3dxl_ns.query.engine import PerGaussian
from lang3dxl_ns.query.visibility import VisibleGaussians
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.scene.camera import Camera

_LOG_SCALES = (-12.0, 9.0)
"""Range of the logarithms of standard deviations in the renderer's packed form."""
_MOST_PRODUCTS = 30_000
"""Most multiplications per Gaussian for which the page decodes codes itself; beyond, it gets decoded rows."""
_MOST_ROW_BYTES = 200_000_000
_FARTHEST, _MOST_BEYOND = 65_504.0, 0.01
"""Largest number of half precision, and the share of Gaussians that may lie beyond it."""
LEAST_PIXELS, PIXEL_STEPS = 0.05, 12
"""Pixels of a view that code 0 stands for, and codes per doubling; 12.75 would reach only 50,000 pixels."""


# ── splats ──────────────────────────────────────────────────────────────────────────────────────────────


def splat_bytes(
    splats: Splats, center: Float[Tensor, "3"], toward: Float[Tensor, "3"]
) -> UInt8[Array, "n 16"]:
    """Pack splats into 16 bytes per Gaussian, in Spark's format: red, green, blue, opacity; half-precision
    means; two octahedral coordinates of the rotation's axis; three logarithmic scales; the rotation's angle.
    Gaussians with a NaN or infinite value become invisible, so that row numbers stay those of the scene. Half
    precision is finest close to `center`, the origin of the packed means, and ends 65,504 units from it.
    Colors are those seen from `toward` (both in world units). Raises UserError if more than a few Gaussians
    lie farther out; those few become dots at the end."""
    sound = splats.sound()[:, None]
    offsets = torch.where(sound, splats.means - center, 0.0)
    if float((offsets.abs().amax(1) > _FARTHEST).float().mean()) > _MOST_BEYOND:
        raise UserError(
            f"a page holds Gaussians up to {_FARTHEST:,.0f} units from the scene's middle, and many of this "
            "scene's lie beyond: make the splat smaller (from millimeters to meters, say), and attach again"
        )
    means = offsets.clamp(-_FARTHEST, _FARTHEST).cpu().numpy().astype("<f2")
    axes, angle = _octahedral(torch.where(sound, splats.quats, 0.0).cpu().double())
    lowest, highest = _LOG_SCALES
    logs = torch.where(sound, splats.scales, 1.0).clamp_min(1e-30).log()
    scales = ((logs - lowest) * 254 / (highest - lowest)).round().clamp(0, 254) + 1
    packed = np.empty((len(splats), 16), np.uint8)
    packed[:, :4] = color_bytes(splats, toward)
    packed[:, 4:10] = means.view(np.uint8).reshape(len(splats), 6)
    packed[:, 10:12] = axes
    packed[:, 12:15] = scales.cpu().numpy()
    packed[:, 15] = angle
    return packed


def color_bytes(splats: Splats, toward: Float[Tensor, "3"]) -> UInt8[Array, "n 4"]:
    """Convert red, green, blue and opacity to bytes; see `splat_bytes`."""
    values = torch.cat([splats.colors(toward), splats.opacities[:, None]], dim=1)
    values = torch.where(splats.sound()[:, None], values, 0.0).clamp(0, 1)
    return (values * 255).round().byte().cpu().numpy()


def _octahedral(quats: Float[Tensor, "n 4"]) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    """Convert rotations to octahedral coordinates of their axes and angles (0 to π), both as 0…255."""
    quats = torch.where(quats.norm(dim=1, keepdim=True) > 0, quats, quats.new_tensor([1.0, 0, 0, 0]))
    quats = F.normalize(quats, dim=1)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    length = quats[:, 1:].norm(dim=1, keepdim=True)
    axis = torch.where(length > 1e-9, quats[:, 1:] / length.clamp_min(1e-9), quats.new_tensor([1.0, 0, 0]))
    flat = axis[:, :2] / axis.abs().sum(1, keepdim=True)
    folded = (1 - flat.abs().flip(1)) * torch.where(flat >= 0, 1.0, -1.0)
    flat = torch.where(axis[:, 2:] < 0, folded, flat)
    angle = 2 * torch.atan2(length[:, 0], quats[:, 0])
    return (255 * (flat + 1) / 2).round().numpy(), (255 * angle / torch.pi).round().numpy()


# ── meaning ─────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class PackedMeaning:
    """Data for decoding every Gaussian's row ((h, 1) / |d|) in the page, and the matrix that adapts texts."""

    description: dict[str, Any]
    """Sizes and settings, for the page's decode.js."""
    files: dict[str, bytes]
    head: Float[Tensor, "r c"] | None
    """Matrix that turns a row into a unit feature; None if rows are unit features already."""

    def of_texts(self, vectors: Float[Tensor, "v c"]) -> Float[Tensor, "v r"]:
        """Compute the r numbers of each text whose product with a row is the cosine."""
        return vectors if self.head is None else vectors @ self.head.T


def packed_meaning(decoder: Decoder, codes: Float[Tensor, "n d"]) -> PackedMeaning:
    """Pack codes and a small field or, for wide decoders, decoded rows. Raises UserError if too large."""
    decoded = PerGaussian.of(decoder, codes)
    rows = decoded.rows.cpu()
    width = rows.shape[1]
    gram = None if decoded.head is None else (decoded.head @ decoded.head.T).flatten().tolist()
    description = {"count": len(rows), "width": width, "gram": gram}
    if decoded.head is not None and isinstance(decoder, SemanticField) and _is_small(decoder):
        settings, files = _packed_field(decoder)
        places = 1 + (torch.nan_to_num(codes).double().sigmoid() * 65534).round()
        files["codes.bin"] = places.cpu().numpy().astype("<u2").tobytes() + halves(rows[:, -1])
        return PackedMeaning(description | {"field": settings}, files, decoded.head)
    if rows.numel() * 2 > _MOST_ROW_BYTES:
        raise UserError(
            f"this scene's decoder has {width} numbers per Gaussian, {rows.numel() * 2 / 1e6:.0f} MB for a "
            "page: train it with the field preset `short`, which a page decodes itself"
        )
    return PackedMeaning(description | {"field": None}, {"rows.bin": halves(rows)}, decoded.head)


def _is_small(field: SemanticField) -> bool:
    """Return whether the page can decode this field: bounded codes, one pass through a grid, small layers."""
    settings = field.settings
    products = sum(layer.weight.numel() for layer in field.layers if isinstance(layer, torch.nn.Linear))
    return settings.bounding == "sigmoid" and not settings.indexed and products <= _MOST_PRODUCTS


def _packed_field(field: SemanticField) -> tuple[dict[str, Any], dict[str, bytes]]:
    grid, settings, table = field.grid, field.settings, field.grid.table.detach()
    layers = [layer for layer in field.layers if isinstance(layer, torch.nn.Linear)]
    described = {
        "dimensions": settings.code_dim,
        "frequencies": settings.fourier_frequencies,
        "features": grid.features_per_level,
        "entries": grid.entries,
        "cells": grid.cells.tolist(),
        "offsets": grid.offsets.tolist(),
        "dense": grid.dense_levels,
        "mask": grid.hash_mask,
        "primes": list(HASH_PRIMES[: settings.code_dim]),
        "layers": [[layer.in_features, layer.out_features] for layer in layers],
        "rectify": [settings.activation == "every" or layer is layers[-1] for layer in layers],
    }
    weights = [np.concatenate([array_of(x.weight.T).ravel(), array_of(x.bias)]) for x in layers]
    return described, {"field.bin": np.concatenate(weights).astype("<f4").tobytes() + halves(table)}


# ── views ───────────────────────────────────────────────────────────────────────────────────────────────


def view_bytes(view: VisibleGaussians, count: int) -> bytes:
    """Pack which Gaussians a view shows (a bit each), and the pixels that each of these fills (a byte)."""
    pixels = view.pixels.float().cpu().numpy()
    keep = pixels >= LEAST_PIXELS
    seen = np.zeros(count, bool)
    seen[view.rows.cpu().numpy()[keep]] = True
    codes = np.rint(PIXEL_STEPS * np.log2(pixels[keep] / LEAST_PIXELS)).clip(0, 255)
    return np.packbits(seen, bitorder="little").tobytes() + codes.astype(np.uint8).tobytes()


def camera_json(camera: Camera) -> dict[str, Any]:
    """Describe a camera for the page: pose (camera → world, nerfstudio's axes, by rows) and pinhole lens."""
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.double().tolist()
    lens = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": camera.width, "height": camera.height}
    return {"pose": camera.pose.tolist(), **lens}


def halves(values: Tensor) -> bytes:
    """Encode values in half precision."""
    return array_of(values).astype("<f2").tobytes()
