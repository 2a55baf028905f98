"""Splat files (PLY, SPZ, SOG, GLB) for other programs."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded, write_atomically
from lang3dxl_ns.files.glb import encode_glb
from lang3dxl_ns.files.ply import encode_ply
from lang3dxl_ns.files.sog import encode_sog
from lang3dxl_ns.files.spz import encode_spz
from lang3dxl_ns.query.question import Question
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.scene.georeference import Georeference

_WRITERS: dict[str, Callable[[Splats, Tensor | None, Georeference | None], bytes]] = {
    ".ply": lambda splats, relevancy, place: encode_ply(splats, relevancy, f"{place or ''}"),
    ".spz": lambda splats, *_: encode_spz(splats),
    ".sog": lambda splats, *_: encode_sog(splats),
    ".glb": lambda splats, _, place: encode_glb(splats, place=place),
}
SPLAT_NAMES = ".ply, .spz, .sog or .glb"


def write_splats(
    path: Path,
    splats: Splats,
    relevancy: Float[Tensor, " n"] | None = None,
    place: Georeference | None = None,
) -> int:
    """Write a .ply, .spz, .sog or .glb file, without Gaussians that have a NaN or infinite value, and return
    the number of those written. relevancy: each Gaussian's to a prompt, 0…1, written to a PLY as the property
    `relevancy`. place: meters, up and north, for a .glb's node and a comment of a PLY. Raises UserError if
    no Gaussian is left, the ending names another kind of file, or .spz cannot hold such coordinates."""
    check_splat_name(path)
    if not len(splats) or not bool((sound := splats.sound()).any()):
        raise UserError(f"no Gaussian is left for {path.name}: write it without --hide-floaters")
    splats, relevancy = splats.select(sound), None if relevancy is None else relevancy[sound]
    write_atomically(path, _WRITERS[path.suffix.lower()](splats, relevancy, place))
    return len(splats)


def write_matching(
    path: Path,
    splats: Splats,
    question: Question,
    everything: bool,
    index: str | Path | None,
    solid: Bool[Tensor, " n"] | None = None,
    place: Georeference | None = None,
) -> int:
    """Write the Gaussians that match a question of one prompt, or all with their relevancy; see
    `Scene.export`. Of these, only `solid` ones are written, if given."""
    relevancy, keep = question.relevancy[0], question.gaussians[0]
    if solid is not None:
        keep = keep & solid
    if not everything and not keep.any():
        best, level = float(relevancy.max()), question.thresholds[0]
        raise UserError(
            f"no Gaussian matches {question.prompts[0].text!r}: the best reaches {best:.2f}; lower "
            f"--threshold, now {level:.2f}, or write all with their relevancy (--all)"
        )
    written = solid if everything else keep
    if written is not None:
        splats, relevancy = splats.select(written), relevancy[written]
    if index is not None:
        write_index(expanded(index), keep)
    return write_splats(path, splats, relevancy, place)


def write_index(path: Path, selected: Bool[Tensor, " n"]) -> None:
    """Write the selected Gaussians' numbers, from 0, as .npy or .txt. Raises UserError for other endings."""
    writers: dict[str, Callable] = {".npy": np.save, ".txt": partial(np.savetxt, fmt="%d")}
    if (kind := path.suffix.lower()) not in writers:
        raise UserError(f"{path.name} has an unsupported list format: use .npy or .txt")
    content = io.BytesIO()
    writers[kind](content, selected.nonzero()[:, 0].cpu().numpy())
    write_atomically(path, content.getvalue())


def check_splat_name(path: Path) -> None:
    """Raise UserError if the path is a folder, or its name ends in none of `SPLAT_NAMES`."""
    if path.is_dir():
        raise UserError(f"{path} is a folder: name a {SPLAT_NAMES} file in it")
    if path.suffix.lower() not in _WRITERS:
        raise UserError(f"{path.name} has an unsupported splat format: use {SPLAT_NAMES}")
