"""Splats of other programs: PLY of any kind, SPZ, SOG, GLB, .splat, checkpoints of gsplat and nerfstudio.

Sizes are compared with the file's before anything of that size is allocated. No code in a file is executed.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from numpy import ndarray as Array
from PIL import Image

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import DAMAGE, UserError, in_a_line, not_of_memory, readable
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.files.activations import check_memory, tensor_of
from lang3dxl_ns.files.checkpoints import read_checkpoint
from lang3dxl_ns.files.glb import read_glb
from lang3dxl_ns.files.ply import read_ply
from lang3dxl_ns.files.scene_file import SUFFIX
from lang3dxl_ns.files.sog import read_sog
from lang3dxl_ns.files.spz import read_spz
from lang3dxl_ns.rendering import Splats, harmonics_of

KINDS = (
    ".ply, .spz, .sog, .glb, .splat, a checkpoint of gsplat (.pt) or nerfstudio (.ckpt), or a run's folder"
)
_IN_FOLDERS = ("*.ckpt", "nerfstudio_models/*.ckpt", "ckpts/*.pt", "point_cloud/iteration_*/point_cloud.ply")
"""Patterns of the files in which programs leave splats in a run's folder."""
_RANK = re.compile(r"(ckpt_\d+_rank)\d+\.pt")
_MOST_DAMAGE = 0.5
"""Share of Gaussians with NaN or infinite values above which a file is refused."""


def find_splats(path: str | Path) -> Path:
    """Find a splat: the path itself, or the latest file in a run's folder. Raises UserError without one."""
    path = expanded(path)
    if path.is_file():
        return path
    if not path.is_dir():
        raise UserError(f"{path} does not exist: name a splat ({KINDS})")
    found = [file for pattern in _IN_FOLDERS for file in path.glob(pattern)]
    if not found:
        raise UserError(f"{path} holds no splat: name one ({KINDS})")
    digits = {file: re.findall(r"\d+", str(Path(*file.parts[-2:]))) for file in found}
    return max(found, key=lambda file: (max(map(int, digits[file]), default=0), file.name))


def read_splats(path: str | Path) -> Splats:
    """Read all Gaussians of a file (one of `KINDS`), in the file's order. Those with NaN or infinite values
    keep their place, but lose their size and opacity. Raises UserError if the file is missing, damaged, too
    large for this machine or of another kind, or most of its values are not finite."""
    path = find_splats(path)
    reader = _reader(path)
    if reader is None:
        told = f"has an unsupported format: give {KINDS}; SuperSplat makes a .ply of others"
        if path.suffix == SUFFIX:
            told = "is a scene already: ask it, or give a splat that `lang3dxl export` wrote"
        raise UserError(f"{path.name} {told}")
    try:
        # gsplat on several GPUs leaves a file of each (ckpt_6999_rank1.pt).
        ranks = _RANK.fullmatch(path.name)
        near = path.parent.glob(f"{ranks[1]}*.pt") if ranks else [path]
        files = sorted(file for file in near if not ranks or _RANK.fullmatch(file.name))  # no copies of them
        if len(files) > 1:
            say(f"{path}: its splat lies in {len(files)} files, a GPU's each, which are joined")
        splats = _joined([reader(file) for file in files])
    except ImportError as error:
        raise UserError(f"{path.suffix} files need gsply: pip install -e '.[share]'") from error
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except (Image.DecompressionBombError, *DAMAGE) as error:
        not_of_memory(error)
        reason = in_a_line(error)
        raise UserError(f"{path} is damaged or incomplete ({reason}): copy or export it again") from error
    return _finite(splats, path)


def _reader(path: Path) -> Callable[[Path], Splats] | None:
    """Find the reader of a file: that of its first bytes, since people rename files, or of its ending."""
    with readable(f"{path} can't be opened", "allow it, or copy it again"), path.open("rb") as file:
        start = file.read(4)
    kind = next((kind for first, kind in _BEGINNINGS.items() if start.startswith(first)), path.suffix.lower())
    return _READERS.get(kind)


def _joined(parts: list[Splats]) -> Splats:
    """Join Gaussians of several files, in their order."""
    names = ("means", "quats", "scales", "opacities", "harmonics")
    joined: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    return replace(parts[0], **joined)


def _finite(splats: Splats, path: Path) -> Splats:
    """Return the same Gaussians, with those made invisible that have NaN or infinite values, or neither a
    rotation nor a size, as rows of zeros have."""
    if not len(splats):
        raise UserError(f"{path} holds no Gaussian: export it again")
    finite = splats.sound() & (splats.means.abs() < 1e9).all(1) & (splats.scales >= 0).all(1)
    if (share := 1 - float(finite.float().mean())) > _MOST_DAMAGE:
        raise UserError(f"{path}: {share:.0%} of its Gaussians have NaN or infinite values; export it again")
    sound = finite & (splats.quats != 0).any(1) & (splats.scales > 0).any(1)
    if sound.all():
        return splats
    if not sound.any():
        raise UserError(f"{path}: all its Gaussians are without rotation or size; export it again")
    why = "NaN or infinite values" if (finite == sound).all() else "no rotation, no size, or no numbers"
    say(f"{path}: {1 - float(sound.float().mean()):.2%} of its Gaussians have {why}; they are left invisible")
    place, keep = splats.means[sound].median(0).values, sound[:, None]
    return replace(
        splats,
        means=torch.where(keep, splats.means, place),
        quats=torch.where(keep, splats.quats, splats.quats.new_tensor([1.0, 0, 0, 0])),
        scales=torch.where(keep, splats.scales, 1e-9),
        opacities=torch.where(sound, splats.opacities, 0.0),
        harmonics=torch.where(keep[..., None], splats.harmonics, 0.0),
    )


_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


def _splat(path: Path) -> Splats:
    """Read the format of the first web viewers: 32 bytes per Gaussian, with one color."""
    size = path.stat().st_size
    expect(size % _SPLAT.itemsize == 0, f"{size} bytes are not whole Gaussians of {_SPLAT.itemsize} bytes")
    check_memory(size // _SPLAT.itemsize, 1)
    table = np.fromfile(path, _SPLAT)
    colors = torch.from_numpy(table["color"].astype(np.float32) / 255)
    quats: Float32[Array, "n 4"] = (table["quat"].astype(np.float32) - 128) / 128
    means, scales = tensor_of(table["mean"]), tensor_of(table["scale"])
    return Splats(means, tensor_of(quats), scales, colors[:, 3], harmonics_of(colors[:, :3]))


_READERS: dict[str, Callable[[Path], Splats]] = {
    **{".ply": read_ply, ".spz": read_spz, ".splat": _splat, ".sog": read_sog, ".glb": read_glb},
    **{".pt": read_checkpoint, ".pth": read_checkpoint, ".ckpt": read_checkpoint},
}
_BEGINNINGS = {b"ply\n": ".ply", b"ply\r": ".ply", b"glTF": ".glb", b"NGSP": ".spz", b"\x1f\x8b\x08": ".spz"}
