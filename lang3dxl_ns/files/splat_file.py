"""Splat files (PLY, SPZ) for other programs."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.files.ply import encode_ply
from lang3dxl_ns.files.spz import encode_spz
from lang3dxl_ns.rendering import Splats


def write_splats(path: Path, splats: Splats, relevancy: Float[Tensor, " n"] | None = None) -> int:
    """Write a .ply or .spz file, without Gaussians that have a NaN or infinite value, and return the number
    of those written. relevancy: each Gaussian's to a prompt, 0…1, written to a PLY as the property
    `relevancy`. Raises UserError if the ending names another kind of file, or .spz cannot hold such
    coordinates."""
    check_splat_name(path)
    sound = splats.sound()
    splats, relevancy = splats.select(sound), None if relevancy is None else relevancy[sound]
    write_atomically(
        path, encode_ply(splats, relevancy) if path.suffix.lower() == ".ply" else encode_spz(splats)
    )
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
