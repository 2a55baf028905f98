"""Gaussians as arrays, and as splat files (PLY, SPZ) for other programs."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.rendering.gaussians import Gaussians

_SH_OF_GRAY = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 √π): color = 0.5 + this × coefficient."""
_LEAST_OPACITY = 1e-6


@dataclass(frozen=True, repr=False)
class GaussianArrays:
    """Gaussians with activated values (no logarithms, no logits), in the model's frame. `arrays[mask]` picks
    some of them."""

    means: Float32[Array, "n 3"]
    quats: Float32[Array, "n 4"]
    """Unit quaternions (w, x, y, z)."""
    scales: Float32[Array, "n 3"]
    """Standard deviations along the rotated axes."""
    opacities: Float32[Array, " n"]
    """0…1."""
    colors: Float32[Array, "n 3"]
    """Red, green and blue, 0 and above."""
    relevancy: Float32[Array, " n"] | None = None
    """To the prompt, 0…1."""
    harmonics: Float32[Array, "n k 3"] | None = None
    """Spherical harmonics of colors that depend on the view, the constant ones first; None: they don't, or a
    photo's look is mixed into `colors`."""

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        with_relevancy = "" if self.relevancy is None else ", with relevancy"
        return f"GaussianArrays({len(self):,} Gaussians{with_relevancy})"

    def __getitem__(self, keep: Bool[Array, " n"]) -> GaussianArrays:
        return GaussianArrays(*(None if a is None else a[keep] for a in vars(self).values()))  # type: ignore[arg-type]

    @classmethod
    def of(
        cls,
        gaussians: Gaussians,
        colors: Float[Tensor, "n 3"],
        relevancy: Float[Tensor, " n"] | None = None,
        harmonics: Float[Tensor, "n k 3"] | None = None,
    ) -> GaussianArrays:
        """The Gaussians on the CPU, without gradient."""
        g = gaussians
        return cls(
            _array(g.means),
            _array(torch.nn.functional.normalize(g.quats, dim=1)),
            _array(g.scales),
            _array(g.opacities),
            _array(colors),
            None if relevancy is None else _array(relevancy),
            None if harmonics is None else _array(harmonics),
        )

    def sound(self) -> GaussianArrays:
        """Without those that have a NaN or infinite value."""
        parts = (self.means, self.quats, self.scales, self.opacities[:, None], self.colors)
        table = np.concatenate(parts if self.harmonics is None else (*parts, self._flat), axis=1)
        return self[np.isfinite(table).all(axis=1)]

    @property
    def coefficients(self) -> Float32[Array, "n k 3"]:
        """Spherical harmonics, of degree 0 if colors don't depend on the view."""
        return (self.colors[:, None] - 0.5) / _SH_OF_GRAY if self.harmonics is None else self.harmonics

    @property
    def logits(self) -> Float32[Array, " n"]:
        """Of the opacities."""
        opacities = self.opacities.clip(_LEAST_OPACITY, 1 - _LEAST_OPACITY)
        return np.log(opacities / (1 - opacities))

    @property
    def log_scales(self) -> Float32[Array, "n 3"]:
        """Logarithms of the scales."""
        return np.log(self.scales.clip(1e-30))

    @property
    def _flat(self) -> Float32[Array, "n 3k"]:
        assert self.harmonics is not None
        return self.harmonics.reshape(len(self), -1)


def write_gaussians(path: Path, gaussians: GaussianArrays) -> int:
    """Write a .ply (relevancy as the property `relevancy`) or .spz file; returns how many Gaussians.

    Those with a NaN or infinite value are left out. Raises UserError for another kind of file, and for .spz
    without gsply installed.
    """
    check_splat_name(path)
    gaussians = gaussians.sound()
    write_atomically(path, _ply(gaussians) if path.suffix.lower() == ".ply" else _spz(gaussians))
    return len(gaussians)


def check_splat_name(path: Path) -> None:
    """Raises UserError for a folder, and for a name that ends in neither .ply nor .spz."""
    if path.is_dir():
        raise UserError(f"{path} is a folder: name a .ply or .spz file in it")
    if path.suffix.lower() not in (".ply", ".spz"):
        raise UserError(f"{path.name} names no kind of splat file: end it in .ply or .spz")


def _ply(g: GaussianArrays) -> bytes:
    """In the layout of 3D Gaussian splatting, which ordinary splat viewers open."""
    coefficients = g.coefficients
    blocks = {
        ("x", "y", "z"): g.means,
        ("nx", "ny", "nz"): np.zeros_like(g.means),
        _numbered("f_dc", 3): coefficients[:, 0],
        # Channel by channel, as viewers expect.
        _numbered("f_rest", 3 * (coefficients.shape[1] - 1)): coefficients[:, 1:]
        .transpose(0, 2, 1)
        .reshape(len(g), -1),
        ("opacity",): g.logits[:, None],
        _numbered("scale", 3): g.log_scales,
        _numbered("rot", 4): g.quats,
    }
    if g.relevancy is not None:
        blocks[("relevancy",)] = g.relevancy[:, None]
    names = [name for group in blocks for name in group]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(g)}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    table = np.concatenate(list(blocks.values()), axis=1)
    return "\n".join(header).encode() + np.ascontiguousarray(table, dtype="<f4").tobytes()


def _spz(g: GaussianArrays) -> bytes:
    """Niantic's compressed format: 8 bits per value, 24 bits per coordinate, no relevancy."""
    try:
        import gsply
    except ImportError as error:
        raise UserError(".spz files need gsply: pip install 'lang3dxl-ns[share]', or write a .ply") from error
    coefficients = g.coefficients
    data = gsply.GSData(
        g.means, g.log_scales, g.quats, g.logits, coefficients[:, 0], coefficients[:, 1:].copy()
    )
    farthest = float(np.abs(g.means).max(initial=1e-3))
    bits = int(np.clip(np.floor(22 - np.log2(farthest)), 1, 20))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.spz"
        gsply.write_spz(path, data, fractional_bits=bits)
        return path.read_bytes()


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{i}" for i in range(count))


def _array(tensor: Tensor) -> Float32[Array, "n ..."]:
    return tensor.detach().cpu().float().numpy()
