"""Checkpoints of gsplat's trainers and nerfstudio's splatfacto, read without executing code in them."""

from __future__ import annotations

import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import torch
from torch import Tensor

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.activations import ALL_BANDS, activated, check_memory, flat
from lang3dxl_ns.rendering import Splats, harmonics_of


class _NumPyScalar:
    """Placeholder for NumPy's scalars in pickles, such as a trainer's learning rates; it takes anything."""

    def __init__(self, *_: Any) -> None: ...

    def __setstate__(self, _: Any) -> None: ...


_SCALARS = (
    *("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar", "numpy.dtype"),
    "_codecs.encode",  # makes their bytes, in the pickles that torch.save writes
)
"""Names in pickles that `_NumPyScalar` replaces."""
_NEWER_NAMES = {"means3d": "means"}
"""Present names of what older versions of gsplat's trainers saved."""


def read_checkpoint(path: Path) -> Splats:
    """Read the Gaussians of a checkpoint of any version. Raises UserError for those of other programs, and
    one of `DAMAGE` for a damaged one."""
    if not is_zipfile(path):
        raise UserError("it is not a checkpoint of torch 1.6 or later: save it again with a newer torch")
    try:
        with torch.serialization.safe_globals([(_NumPyScalar, name) for name in _SCALARS]):
            state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        raise ValueError("it holds more than tensors, or is no checkpoint; nothing in it was run") from error
    parts = state if isinstance(state, dict) else {}
    if isinstance(parts.get("pipeline"), dict):
        return _splatfacto(parts["pipeline"], path)
    if isinstance(parts.get("splats"), dict):
        return _gsplat(parts["splats"], path)
    raise UserError("it is a checkpoint of a program other than gsplat and nerfstudio: give a .ply of it")


def _gsplat(parts: Mapping[str, Any], path: Path) -> Splats:
    """Build splats from what gsplat's example trainers save; older ones call the means means3d."""
    parts = {_NEWER_NAMES.get(name, name): value for name, value in parts.items()}
    _check_parts(parts, ("means", "scales", "quats", "opacities"))
    if "sh0" not in parts:
        raise UserError("a network makes its colors (app_opt): train it without, or export a PLY")
    harmonics = torch.cat([parts[name] for name in ("sh0", "shN") if name in parts], dim=1)
    run, scales = path.parent.parent, parts["scales"]
    if _configured(run / "cfg.json", '"model_type": "2dgs'):  # nothing was drawn with the third
        scales = flat(scales[:, :2])
    antialiased = _configured(run / "cfg.yml", "antialiased: true")
    return activated(parts["means"], scales, parts["quats"], parts["opacities"], harmonics, antialiased)


def _splatfacto(pipeline: Mapping[str, Any], path: Path) -> Splats:
    """Build splats from nerfstudio's splatfacto of any version; older ones call the means _model.means, and
    keep all harmonics in colors_all."""
    names = {name: re.fullmatch(r"_model\.(?:gauss_params\.)?([^.]+)", name) for name in pipeline}
    own = {found[1]: pipeline[name] for name, found in names.items() if found}
    if isinstance(every := own.get("colors_all"), Tensor) and every.ndim == 3:
        own |= {"features_dc": every[:, 0], "features_rest": every[:, 1:]}
    _check_parts(own, ("means", "scales", "quats", "opacities", "features_dc", "features_rest"))
    first, rest = own["features_dc"].float().reshape(-1, 1, 3), own["features_rest"].float()
    if not rest.shape[1]:  # the colors themselves, as logits
        first = harmonics_of(first[:, 0].sigmoid())
    antialiased = _configured(path.parent.parent / "config.yml", "rasterize_mode: antialiased")
    harmonics = torch.cat([first, rest.reshape(len(first), -1, 3)], dim=1)
    return activated(own["means"], own["scales"], own["quats"], own["opacities"], harmonics, antialiased)


def _configured(config: Path, line: str) -> bool:
    """Return whether the run's settings hold this line."""
    return config.is_file() and line in config.read_text(errors="replace")


def _check_parts(parts: Mapping[str, Any], names: tuple[str, ...]) -> None:
    missing = [name for name in names if not isinstance(parts.get(name), Tensor)]
    if missing:
        raise UserError(f"it is not a splat: it has no {', '.join(missing)}")
    count = len(parts["means"])
    for name, value in parts.items():
        expect(name not in names or len(value) == count, f"{name} are not as many as means")
        if isinstance(value, Tensor):
            stored = value.untyped_storage().nbytes()
            expect(value.is_cpu and value.nbytes <= stored, f"{name} is larger than what is stored of it")
    check_memory(count, ALL_BANDS)
