"""Splat PLY export, in the layout of 3D Gaussian splatting."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.files import write_atomically

_SH_OF_GRAY = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 √π): color = 0.5 + this × coefficient."""


def write_splats(
    path: Path,
    gaussians: Mapping[str, Float[Tensor, "n ..."]],
    keep: Bool[Tensor, " n"] | None = None,
    scores: Float[Tensor, " n"] | None = None,
) -> int:
    """Write the Gaussians in `keep` (default: all), with a property `score` if given; returns how many.

    gaussians: `means`, `features_dc`, `features_rest` [n, k, 3], `opacities` (logits), `scales` (logarithms),
    `quats` (w, x, y, z), as the model has them. Those with a NaN or infinite value are left out.
    """
    columns = _columns(gaussians)
    if scores is not None:
        columns["score"] = scores
    table = torch.stack([column.detach().cpu().float() for column in columns.values()], dim=1)
    sound = table.isfinite().all(1)
    chosen = sound if keep is None else sound & keep.cpu()
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {int(chosen.sum())}"]
    header += [f"property float {name}" for name in columns] + ["end_header", ""]
    body = np.ascontiguousarray(table[chosen].numpy(), dtype="<f4").tobytes()
    write_atomically(path, "\n".join(header).encode() + body)
    return int(chosen.sum())


def _columns(g: Mapping[str, Tensor]) -> dict[str, Float[Tensor, " n"]]:
    means, rest = g["means"], g["features_rest"]
    # Without harmonics the model stores logits of colors.
    base = g["features_dc"] if rest.shape[1] else (g["features_dc"].sigmoid() - 0.5) / _SH_OF_GRAY
    blocks = {
        ("x", "y", "z"): means,
        ("nx", "ny", "nz"): torch.zeros_like(means),
        _numbered("f_dc", 3): base,
        # Channel by channel, as viewers expect.
        _numbered("f_rest", 3 * rest.shape[1]): rest.transpose(1, 2).flatten(1),
        ("opacity",): g["opacities"],
        _numbered("scale", 3): g["scales"],
        _numbered("rot", 4): torch.nn.functional.normalize(g["quats"], dim=1),
    }
    return {name: block[:, i] for names, block in blocks.items() for i, name in enumerate(names)}


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{i}" for i in range(count))
