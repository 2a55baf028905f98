"""Splat files (PLY, SPZ) for other programs."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.rendering import Splats

LEAST_OPACITY = 1e-6
"""Smallest distance of stored opacities from 0 and 1, where logits are infinite."""


def write_splats(path: Path, splats: Splats, relevancy: Float[Tensor, " n"] | None = None) -> int:
    """Write a .ply or .spz file, without Gaussians that have a NaN or infinite value, and return the number
    of those written. relevancy: each Gaussian's to a prompt, 0…1, written to a PLY as the property
    `relevancy`. Raises UserError if the ending names another kind of file, or gsply is missing for .spz."""
    check_splat_name(path)
    sound = splats.sound()
    splats, relevancy = splats.select(sound), None if relevancy is None else relevancy[sound]
    write_atomically(path, _ply(splats, relevancy) if path.suffix.lower() == ".ply" else _spz(splats))
    return len(splats)


def write_index(path: Path, selected: Bool[Tensor, " n"]) -> None:
    """Write the selected Gaussians' numbers, from 0, as .npy or .txt. Raises UserError for other endings."""
    writers: dict[str, Callable] = {".npy": np.save, ".txt": partial(np.savetxt, fmt="%d")}
    if (kind := path.suffix.lower()) not in writers:
        raise UserError(f"{path.name} names no kind of list: end it in .npy or .txt")
    content = io.BytesIO()
    writers[kind](content, selected.nonzero()[:, 0].cpu().numpy())
    write_atomically(path, content.getvalue())


def check_splat_name(path: Path) -> None:
    """Raise UserError if the path is a folder, or its name ends in neither .ply nor .spz."""
    if path.is_dir():
        raise UserError(f"{path} is a folder: name a .ply or .spz file in it")
    if path.suffix.lower() not in (".ply", ".spz"):
        raise UserError(f"{path.name} names no kind of splat file: end it in .ply or .spz")


def logits(splats: Splats) -> Float[Tensor, " n"]:
    """Compute the logits of the opacities."""
    return splats.opacities.clamp(LEAST_OPACITY, 1 - LEAST_OPACITY).logit()


def log_scales(splats: Splats) -> Float[Tensor, "n 3"]:
    """Compute the logarithms of the scales."""
    return splats.scales.clamp_min(1e-30).log()


def _ply(splats: Splats, relevancy: Float[Tensor, " n"] | None) -> bytes:
    """Encode the layout of 3D Gaussian splatting, which ordinary splat viewers open."""
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
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    table = np.concatenate([array_of(block) for block in blocks.values()], axis=1)
    return "\n".join(header).encode() + np.ascontiguousarray(table, dtype="<f4").tobytes()


def _spz(splats: Splats) -> bytes:
    """Encode Niantic's compressed format: 8 bits per value, 24 bits per coordinate, no relevancy."""
    try:
        import gsply
    except ImportError as error:
        raise UserError(".spz files need gsply: pip install 'lang3dxl-ns[share]', or write a .ply") from error
    quats, harmonics = F.normalize(splats.quats, dim=1), splats.harmonics
    parts = (splats.means, log_scales(splats), quats, logits(splats), harmonics[:, 0], harmonics[:, 1:])
    means, scales, turned, opacities, base, rest = (np.array(array_of(part)) for part in parts)
    data = gsply.GSData(means, scales, turned, opacities, base, rest)
    farthest = float(splats.means.abs().max()) if len(splats) else 0.0
    bits = int(min(np.floor(22 - np.log2(max(farthest, 1e-3))), 20))
    if bits < 0:
        raise UserError(
            f".spz holds coordinates up to 4 million, and these reach {farthest:,.0f}: write a .ply"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.spz"
        gsply.write_spz(path, data, fractional_bits=bits)
        return path.read_bytes()


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{i}" for i in range(count))


def array_of(tensor: Tensor) -> Float32[Array, "..."]:
    """Return a tensor as a NumPy array of float32, without gradient."""
    return tensor.detach().cpu().float().numpy()
