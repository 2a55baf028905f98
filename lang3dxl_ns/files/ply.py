"""PLY of splats: as 3D Gaussian splatting writes it, in any types, byte order and form, and SuperSplat's."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.pictures import color_bytes
from lang3dxl_ns.common.ply_tables import Table, plainly, read_header, read_vertices
from lang3dxl_ns.files.activations import (
    ALL_BANDS,
    activated,
    array_of,
    check_memory,
    flat,
    log_scales,
    logits,
)
from lang3dxl_ns.rendering import Splats, harmonics_of

_NEEDED = ("x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3")
_COLORS, _HARMONICS = ("red", "green", "blue"), ("f_dc_0", "f_dc_1", "f_dc_2")
_ANTIALIASED = re.compile(r"comment\s+(splatrendermode:\s*mip|antialiased:?\s*(1|true))\s*", re.IGNORECASE)
"""Comments by which programs tell that a splat was trained with antialiasing."""
_BY_CHANCE = 6
"""Gaussians up to which logits may all lie between 0 and 1."""


def read_ply(path: Path) -> Splats:
    """Read the Gaussians of a PLY. Raises UserError for a point cloud and for columns of unknown types, and
    one of `DAMAGE` for a damaged file."""
    with path.open("rb") as file:
        form, tables, lines = read_header(file)
        vertices = tables.get("vertex", Table(0))
        names = [name for name, _ in vertices.columns]
        antialiased = any(map(_ANTIALIASED.fullmatch, lines))
        if "chunk" in tables and "packed_position" in names:
            return replace(_supersplat(path, tables), antialiased=antialiased)
        known = plainly({name: name for name in names})
        colors = _COLORS if _COLORS[0] in known and _HARMONICS[0] not in known else _HARMONICS
        if missing := [name for name in (*_NEEDED, *colors) if name not in known]:
            told = ", ".join(missing[:3])
            if "opacity" in known:
                raise UserError(f"its Gaussians have no {told}: export them as 3D Gaussian splatting does")
            raise UserError(f"not a splat but a point cloud: its points have no {told}")
        check_memory(vertices.length, 1 + sum(name.startswith("f_rest_") for name in known) // 3)
        columns = read_vertices(file, form, tables)
        splats = _splats_of({plain: columns[name] for plain, name in known.items() if name in columns})
        return replace(splats, antialiased=antialiased)


def _splats_of(table: Any) -> Splats:
    """Build splats from the columns that 3D Gaussian splatting writes."""

    def columns(*names: str) -> Float[Tensor, "n k"]:
        return torch.from_numpy(np.stack([table[name].astype(np.float32) for name in names], axis=1))

    rest = sorted(filter(re.compile(r"f_rest_\d+").fullmatch, table), key=lambda name: int(name[7:]))
    if _HARMONICS[0] in table:
        first = columns(*_HARMONICS)[:, None]
    else:
        plain = np.stack([table[name] for name in _COLORS], axis=1)
        whole = plain.dtype.kind != "f"  # 0 to 255, or 0 to 1, where each may be dark
        colors = torch.from_numpy((color_bytes(plain) if whole else plain).astype(np.float32))
        first = harmonics_of(colors / (255 if whole or (colors > 1).any() else 1))
    if len(rest) not in (0, 9, 24, 45, 72):
        raise UserError(f"it has {len(rest)} columns f_rest, not 9, 24, 45 or 72: export it anew")
    # Coefficients are stored channel by channel.
    others = columns(*rest).reshape(len(first), 3, len(rest) // 3).mT if rest else first[:, :0]
    scales = columns(*(name for name in ("scale_0", "scale_1", "scale_2") if name in table))
    scales, opacities = _stored(scales, columns("opacity"))
    if scales.shape[1] == 2:
        scales = flat(scales)
    quats, harmonics = columns("rot_0", "rot_1", "rot_2", "rot_3"), torch.cat([first, others], dim=1)
    splats = activated(columns("x", "y", "z"), scales, quats, opacities, harmonics)
    if "filter_3d" in table:  # Mip-Splatting draws each Gaussian blurred by this, and as much fainter
        wide = (splats.scales.square() + columns("filter_3d").square()).sqrt().clamp_min(1e-30)
        fainter = splats.opacities * (splats.scales / wide).prod(1)
        splats = replace(splats, scales=wide, opacities=fainter)
    return splats


def _stored(
    scales: Float[Tensor, "n k"], opacities: Float[Tensor, "n 1"]
) -> tuple[Float[Tensor, "n k"], Float[Tensor, "n 1"]]:
    """Return scales as logarithms and opacities as logits, as which most programs store them; say if they are
    stored as they are."""
    # Logits are never all between 0 and 1 (opacities of .5 to .73), so that logarithms above 0 are none then.
    within = bool(((opacities >= 0) & (opacities <= 1)).all() and opacities.any())
    if len(opacities) <= _BY_CHANCE or not within:
        return scales, opacities
    if bool((scales[:, :2] > 0).all()):
        say("its sizes and opacities are not logarithms and logits, and are taken as they are")
        return scales.clamp_min(1e-9).log(), opacities.logit()
    say("its opacities are not logits, and are taken as they are")
    return scales, opacities.logit()


def _supersplat(path: Path, tables: dict[str, Table]) -> Splats:
    """Read SuperSplat's compressed PLY, which stores chunks of 256 Gaussians."""
    import gsply

    if "min_r" not in [name for name, _ in tables["chunk"].columns]:
        raise UserError("an older SuperSplat wrote it: open it in the current one, and save it again")
    count, chunks = tables["vertex"].length, tables["chunk"].length
    expect(chunks == -(-count // 256), f"{count:,} Gaussians don't lie in {chunks:,} chunks")
    expect("sh" not in tables or tables["sh"].length == count, "its harmonics are of other Gaussians")
    check_memory(count, ALL_BANDS)
    data = gsply.plyread(path)
    parts = [np.asarray(part) for part in (data.sh0, data.shN) if part is not None]
    bands = np.concatenate([part.reshape(len(data.means), -1, 3) for part in parts], axis=1)
    return activated(data.means, data.scales, data.quats, data.opacities, bands)


def encode_ply(splats: Splats, relevancy: Float[Tensor, " n"] | None = None, comment: str = "") -> bytes:
    """Encode the layout of 3D Gaussian splatting, which ordinary splat viewers open, with the relevancy (0…1)
    as a further column, and a comment of one line."""
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
    header += [f"comment {comment}"] if comment else []
    header += [f"element vertex {count}", *(f"property float {name}" for name in names), "end_header", ""]
    table = np.concatenate([array_of(block) for block in blocks.values()], axis=1)
    # Other readers, such as plyfile and gsply, take a header in ASCII alone.
    text = "\n".join(header).replace("±", "+-").encode("ascii", "replace")
    return text + np.ascontiguousarray(table, dtype="<f4").tobytes()


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{i}" for i in range(count))
