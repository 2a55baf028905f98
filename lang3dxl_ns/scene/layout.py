"""Where programs leave the parts of a scene: its COLMAP model, its photos, and cameras of other kinds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import DAMAGE
from lang3dxl_ns.common.files import read_text
from lang3dxl_ns.common.options import capture_option
from lang3dxl_ns.scene.colmap import photos_in_model
from lang3dxl_ns.scene.companions import named_folder
from lang3dxl_ns.scene.photo_folder import find_photos, photos_below, smaller_copies
from lang3dxl_ns.scene.transforms import SPLITS, TRANSFORMS

MODEL_FOLDERS = (
    *(Path("sparse/0"), Path("sparse"), Path("colmap/sparse/0"), Path("colmap/sparse"), Path("dense/sparse")),
    *(Path("colmap"), Path(".")),
)
"""Usual places of a model, the first of which counts. Elsewhere, the model with the most photos does."""
_IMAGES = Path("images")
_DEPTH = 3
"""Levels of folders below a scene's that are searched for a model."""
_RESULTS = ("lang3dxl_cache", "outputs", "nerfstudio_models")
_OTHER_CAMERAS = {
    **{"*.xml": "Metashape", "*.xmp": "RealityScan", "*.csv": "RealityScan", "*.nvm": "VisualSFM"},
    **{"bundle*.out": "Bundler", "sfm_data.json": "OpenMVG", "reconstruction.json": "OpenSfM"},
    **{"*.sfm": "Meshroom", "poses_bounds.npy": "LLFF", "opensfm/reconstruction.json": "OpenDroneMap"},
    **{"keyframes/corrected_cameras": "Polycam", "metadata.json": "Record3D"},
}
"""Files and folders with cameras that can't be read here, and the programs that write them."""
_MARKS = {
    **{"*.xml": "<document", "*.xmp": "capturingreality", "*.csv": "#name,x,"},
    **{"metadata.json": '"poses"'},
}
"""Texts in such files whose names others have too: those of photo editors, and of Google's archives."""


def has_model(folder: Path) -> bool:
    """Return whether a folder has a file of photos of a COLMAP model."""
    return _has_one_of(folder, "images")


def _has_one_of(folder: Path, *parts: str) -> bool:
    """Return whether a folder has the file of one of these parts of a COLMAP model."""
    return any((folder / f"{part}{ending}").is_file() for part in parts for ending in (".bin", ".txt"))


def whole_scene(folder: Path) -> Path:
    """Return the scene's folder where `folder` is just its COLMAP model or its photos, else `folder`."""
    if has_model(folder) and not any(photos_below(folder)):
        above = (parent for parent in folder.parents[:_DEPTH] if any(photos_below(parent / "images")))
        return next(above, folder)
    usual = {
        path: any(has_model(path / place) for place in MODEL_FOLDERS) or _transforms_in(path) is not None
        for path in (folder, folder.parent)
    }
    photos_alone = folder.name == "images" and not usual[folder]
    return folder.parent if photos_alone and usual[folder.parent] else folder


def _transforms_in(folder: Path) -> Path | None:
    return next((folder / name for name in (TRANSFORMS, SPLITS[0]) if (folder / name).exists()), None)


def find_transforms(folder: Path) -> Path | None:
    """Find the transforms.json of a scene's folder: in it, or else the only one below it, if all photos lie
    beside that, which is said; None without one."""
    if (found := _transforms_in(folder)) is not None:
        return found
    below = [found for here in _searched(folder) if (found := _transforms_in(here)) is not None]
    if len(below) != 1:
        return None
    beside = f"{below[0].parent.relative_to(folder).as_posix()}/"
    if not all(name.startswith(beside) for name in photos_below(folder)):
        return None
    say(f"the cameras of {folder} are in {below[0]}, which is used")
    return below[0]


def find_model(folder: Path) -> Path | None:
    """Find the COLMAP model of a scene's folder: in the usual places, else the largest one below it, which is
    said with the others; None without one."""
    for place in MODEL_FOLDERS:
        # Among photos, images.txt may as well be a list of their addresses.
        if has_model(folder / place) and (place.name or _has_one_of(folder, "cameras", "points3D")):
            return folder / place
    models = (here for here in _searched(folder) if has_model(here) and _has_one_of(here, "cameras"))
    found = {model: photos_in_model(model) for model in models}
    if not found:
        return None
    best = max(found, key=lambda model: (found[model], -len(model.parts)))
    told = ", ".join(f"{os.path.relpath(model, folder)} with {count}" for model, count in found.items())
    say(f"{folder} has a COLMAP model in {os.path.relpath(best, folder)}, which is used (photos: {told})")
    return best


def _searched(folder: Path) -> Iterator[Path]:
    """Yield a folder and those below it that may hold cameras."""
    for parent, folders, _ in os.walk(folder):
        here = Path(parent)
        deep = len(here.relative_to(folder).parts) >= _DEPTH
        folders[:] = [] if deep else sorted(f for f in folders if f not in _RESULTS and f[0] not in "._")
        yield here


def images_folder(data: Path, model: Path, named: Path = _IMAGES) -> Path:
    """Return the folder of a model's photos: `named` in the scene's or, where that is the usual one, images/
    nearest above the model (those of an undistorted model lie beside it, the originals farther up), else
    wherever there are photos. Raises UserError if the named one does not exist."""
    if named != _IMAGES:
        return named_folder(named, data, "images-path", capture_option)
    above = [*(parent for parent in model.parents if parent != data and parent.is_relative_to(data)), data]
    for parent in above:
        if any(photos_below(parent / named)):
            return parent / named
    if (found := find_photos(data)).names:
        return found.folder
    smaller = (parent / Path(copies[0]).parts[0] for parent in above if (copies := smaller_copies(parent)))
    return next(smaller, data / named)


def mention_other_cameras(folder: Path) -> None:
    """Say which cameras of other programs lie beside photos that are reconstructed anew."""
    for pattern, program in _OTHER_CAMERAS.items():
        mark = _MARKS.get(pattern)
        if found := next((path for path in folder.glob(pattern) if not mark or _says(path, mark)), None):
            say(
                f"{found} holds cameras of {program}, which can't be read here: the photos are reconstructed "
                "anew. To use them, export a COLMAP model or a transforms.json (ns-process-data) beside it"
            )
    for path in folder.glob("*.json"):
        if _says(path, '"transform_matrix"'):
            say(f"{path} holds cameras, too: to use them, give this file instead of its folder")


def _says(path: Path, text: str) -> bool:
    """Return whether a file can be read and has a text in it."""
    with suppress(*DAMAGE):
        return text in read_text(path)
    return False
