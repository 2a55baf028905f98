"""Reading of a transforms.json, as nerfstudio, instant-ngp and capture apps write it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from numpy import ndarray as Array

from lang3dxl_ns.common.checks import expect, is_coordinate
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError, is_plain, readable
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.scene.camera import Lens, check_pose, rigid, view_matrix
from lang3dxl_ns.scene.colmap import FISHEYE_MODELS, PERSPECTIVE_MODELS, TrackedPhoto
from lang3dxl_ns.scene.companions import inside
from lang3dxl_ns.scene.names import listed, resolve
from lang3dxl_ns.scene.photo import stored_size
from lang3dxl_ns.scene.photo_folder import files_below, photos_below, smaller_copies
from lang3dxl_ns.scene.ply_points import read_ply_points

TRANSFORMS = "transforms.json"
SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
"""Files of Blender's scenes, one for each part of the split."""
_MOST_BYTES = 1 << 30
_PERSPECTIVE = {
    **dict.fromkeys(("PERSPECTIVE", *PERSPECTIVE_MODELS), ("k1", "k2", "p1", "p2", "k3")),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Coefficients of the camera models, in OpenCV's order. Programs write those of another model, too."""
_FISHEYE = ("k1", "k2", "k3", "k4")
_OTHER_LENSES = ("equirectangular", "latlong", "orthographic", "ftheta_p0")
"""Keys by which instant-ngp's files tell a lens of another kind."""
_LISTS = ("train_filenames", "val_filenames", "test_filenames")
_NOTHING = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class Transforms:
    """Contents of a transforms.json."""

    photos: dict[str, TrackedPhoto]
    """Photos with their cameras, by file relative to the folder, sorted; no tracks."""
    masks: dict[str, Path]
    """Masks that it names, by photo."""
    left_out: dict[str, UserError]
    """Photos that can't be used, by the name in the file, with reasons."""
    points: Float64[Array, "m 3"]
    colors: UInt8[Array, "m 3"]
    train: frozenset[str] | None
    """Files that it lists for training; None: it lists none."""
    held_out: frozenset[str] | None
    """Files that it lists for validation and tests."""
    applied: Float64[Array, "3 4"]
    """Transform that was applied to the original coordinates, before `applied_scale`."""
    applied_scale: float


def read_transforms(path: Path) -> Transforms:
    """Read a transforms.json with its points. Photos, masks and points lie in its folder. The files of a
    split are read together. Raises UserError if the file is damaged, lists no photo, or names points outside
    its folder."""
    content = _content(path)
    with readable(f"{path} can't be used", "correct it, or make it again"):
        frames = content["frames"]
        expect(bool(frames), "it lists no photo under frames")
        applied = content.get("applied_transform") or np.eye(4).tolist()
        scale = content.get("applied_scale", 1.0)
        check_pose(applied)
        expect(is_coordinate(scale) and scale > 0, f"applied_scale is {str(scale)[:40]}")
        points, colors = _points(content.get("ply_file_path"), path)
        found, files = _photos(path.parent, content, frames)
        split = [_listed(content.get(key), found, files, key) for key in _LISTS]
    train, *others = split
    held_out = [names for names in others if names is not None]
    return Transforms(
        *found, points, colors, train, frozenset[str]().union(*held_out) if held_out else None,
        np.array(applied, np.float64)[:3], float(scale),
    )  # fmt: skip


def _content(path: Path) -> dict[str, Any]:
    """Read the file, or the files of a split, parts of which may be empty, as one that lists its parts."""
    if path.name != SPLITS[0]:
        return _file(path)
    beside = {key: path.with_name(name) for key, name in zip(_LISTS, SPLITS, strict=True)}
    parts = {key: _file(part) for key, part in beside.items() if part.exists()}
    lists = {key: [frame["file_path"] for frame in part["frames"]] for key, part in parts.items()}
    frames = [{**part, **frame} for part in parts.values() for frame in part["frames"]]
    return parts[_LISTS[0]] | lists | {"frames": frames}


def _file(path: Path) -> dict[str, Any]:
    """Read a file and check that it has a list of photos. Values of null are left out."""
    with readable(f"{path} can't be used", "correct it, or make it again"):
        content: Any = read_json(path, _MOST_BYTES)
        frames: Any = content.get("frames") if isinstance(content, dict) else None
        expect(isinstance(frames, list), "it lists no photo under frames")
        whole = all(isinstance(frame, dict) for frame in frames)
        expect(whole, "a photo is not described by names and values")
        frames = [{key: value for key, value in frame.items() if value is not None} for frame in frames]
        expect(all("file_path" in frame for frame in frames), "a photo has no file_path")
        return {key: value for key, value in content.items() if value is not None} | {"frames": frames}


_Found = tuple[dict[str, TrackedPhoto], dict[str, Path], dict[str, UserError]]
_Files = dict[str, str]


def _photos(folder: Path, content: Mapping[str, Any], frames: list[dict[str, Any]]) -> tuple[_Found, _Files]:
    """Find and read the photos and masks that the frames name; return them, and the photos' files by the
    frames' names."""
    names = [frame["file_path"] for frame in frames]
    for name in names:
        expect(isinstance(name, str) and name != "", f"file_path is {str(name)[:40]!r}, not a path")
    files, left_out = _resolved(folder, names, "photos", photos_below)
    if not files:
        files, left_out = _resolved(folder, names, "photos", smaller_copies)
    wanted = [frame["mask_path"] for frame in frames if isinstance(frame.get("mask_path"), str)]
    masks, bad_masks = _resolved(folder, wanted, "masks", files_below)
    photos, masks_of, scales = dict[str, TrackedPhoto](), dict[str, Path](), list[float]()
    refused = dict[str, UserError]()
    for frame in frames:
        name, mask = frame["file_path"], frame.get("mask_path")
        if name in left_out:
            continue
        try:
            if name not in files:
                raise UserError(f"there is no {folder / name}")
            if (file := files[name]) in refused:
                raise refused[file]
            photo, scale = _photo(folder, file, {**content, **frame})
            if not _alike(photos.setdefault(file, photo), photo):
                raise UserError(f"{file} is listed twice, with other cameras")
            scales.append(scale)
            if mask is not None:
                if mask in bad_masks or mask not in masks:
                    raise bad_masks.get(mask, UserError(f"there is no mask {str(mask)[:80]}"))
                masks_of[file] = folder / masks[mask]
        except UserError as reason:
            left_out[name] = reason
            if name in files:
                refused[files[name]] = reason
                photos.pop(files[name], None)
        except (ValueError, TypeError, KeyError) as error:
            what = f"a photo has no {error}" if isinstance(error, KeyError) else str(error)
            raise ValueError(f"photo {name[:80]}: {what}") from error
    if scaled := [scale for scale in scales if abs(scale - 1) >= 0.01]:
        say(
            f"{len(scaled)} of {len(scales)} poses in {folder / TRANSFORMS} have axes of other lengths than "
            f"1 (such as {scaled[0]:.3g}); they are normalized"
        )
    return (dict(sorted(photos.items())), masks_of, left_out), files


def _alike(one: TrackedPhoto, other: TrackedPhoto) -> bool:
    """Return whether two photos have the same camera."""
    return one.lens == other.lens and np.array_equal(one.camera_from_world, other.camera_from_world)


def _resolved(
    folder: Path, names: list[str], what: str, files: Callable[[Path], Iterable[str]]
) -> tuple[dict[str, str], dict[str, UserError]]:
    """Find the files of names, which may be absolute, have slashes of Windows, and lack their ending. Names
    that lead out of the folder, also by a link in it, are refused."""
    known, refused = dict[str, str](), dict[str, UserError]()
    for name in dict.fromkeys(names):
        short = name
        if Path(name).is_absolute() and Path(name).is_relative_to(folder):
            short = Path(name).relative_to(folder).as_posix()
        known[name] = os.path.normpath(short)
    forms = list(dict.fromkeys(known.values()))
    found, doubts = resolve(forms, lambda form: _is_file(folder, form), lambda: files(folder), what)
    result = dict[str, str]()
    for name, form in known.items():
        if form in doubts:
            refused[name] = doubts[form]
        elif form in found:
            try:
                inside(folder, found[form], follow_links=True)
                _check_links(folder, found[form])
                result[name] = found[form]
            except UserError as reason:
                refused[name] = reason
    return result, refused


def _is_file(folder: Path, name: str) -> bool:
    """Return whether a name is that of a file in the folder, or of a link there."""
    try:
        return inside(folder, name, follow_links=True).is_file()
    except (UserError, OSError, ValueError):
        return False


def _check_links(folder: Path, name: str) -> None:
    """Raise UserError for a link that leads out of its folder. The first folder may be one, as for large
    photos."""
    top, *below = Path(name).parts
    inside(folder / top if below else folder, str(Path(*below)) if below else top)


def _listed(names: Any, found: _Found, files: _Files, key: str) -> frozenset[str] | None:
    """Return the photos that a list of the file names; None without a list."""
    if names is None:
        return None
    photos, _, left_out = found
    texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
    expect(texts, f"{key} is not a list of names")
    return listed([files.get(name, name) for name in names], {*photos, *left_out, *files.values()}, key)


def _points(name: Any, path: Path) -> tuple[Float64[Array, "m 3"], UInt8[Array, "m 3"]]:
    """Read the points that the file names. Without any, training starts from random ones, which is said."""
    folder, nothing = path.parent, (_NOTHING, _NOTHING.astype(np.uint8))
    what = f"{path} names no points (ply_file_path)"
    if name is not None:
        expect(isinstance(name, str) and name != "", f"ply_file_path is {str(name)[:40]!r}, not a path")
        others = (file for file in files_below(folder) if file.lower().endswith(".ply"))
        found, refused = _resolved(folder, [name], "points", lambda _: others)
        if name in refused:
            raise refused[name]
        if name in found:
            return read_ply_points(folder / found[name])
        expect(".." not in Path(name).parts and is_plain(name), f"{name[:80]!r} leads out of {folder}")
        what = f"{path} names points that are not there ({name[:80]})"
    say(
        f"{what}: training starts from random ones, which costs several dB; without this file, the photos "
        "are reconstructed with points"
    )
    return nothing


def _photo(folder: Path, name: str, frame: Mapping[str, Any]) -> tuple[TrackedPhoto, float]:
    """Read a photo's camera, and the scale of its pose. Raises UserError for a camera that can't be used."""
    expect("transform_matrix" in frame, "it has no transform_matrix")
    pose, scale = rigid(frame["transform_matrix"])
    view = view_matrix(torch.from_numpy(pose))[:3].numpy()
    return TrackedPhoto(name, _lens(frame, folder / name, name), view, _NOTHING, _NOTHING[:, :2]), scale


def _lens(frame: Mapping[str, Any], path: Path, name: str) -> Lens:
    model = str(frame.get("camera_model", "OPENCV"))
    upper = model.upper()
    fisheye = upper in FISHEYE_MODELS or bool(frame.get("is_fisheye"))  # instant-ngp's form
    model = next((key for key in _OTHER_LENSES if frame.get(key)), model)
    if (upper not in _PERSPECTIVE and not fisheye) or model in _OTHER_LENSES:
        raise UserError(
            f"photo {name} has a {model[:40]} camera, which can't be undistorted here: undistort it first "
            "(colmap image_undistorter; panoramas: ns-process-data images --camera-type equirectangular)"
        )
    width, height = _size(frame, path, name)
    distortion = _distortion(frame, upper, fisheye, name)
    lens = Lens(width, height, *_focal(frame, width, height), distortion, fisheye)
    lens.check()
    return lens


def _size(frame: Mapping[str, Any], path: Path, name: str) -> tuple[int, int]:
    """Return the width and height that the file tells, or else those of the photo."""
    if "w" not in frame or "h" not in frame:
        return stored_size(path, name)[0]
    sides = [_number(frame, key) for key in "wh"]
    expect(all(side.is_integer() for side in sides), f"its size is {sides[0]} × {sides[1]}")
    return int(sides[0]), int(sides[1])


def _focal(frame: Mapping[str, Any], width: int, height: int) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy. Angles of view may stand for focal lengths, and one axis for both."""

    def along(axis: str, side: int) -> float | None:
        if f"fl_{axis}" in frame:
            return _number(frame, f"fl_{axis}")
        for key, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", math.pi / 180)):
            if frame.get(key) is not None:
                angle = _number(frame, key) * unit
                expect(0 < angle < math.pi, f"its {key} is {frame[key]}")
                return side / 2 / math.tan(angle / 2)
        return None

    known = [focal for focal in (along("x", width), along("y", height)) if focal is not None]
    if not known:
        raise KeyError("fl_x or camera_angle_x")
    cx, cy = (
        _number(frame, key) if key in frame else side / 2 for key, side in (("cx", width), ("cy", height))
    )
    return known[0], known[-1], cx, cy


def _distortion(frame: Mapping[str, Any], model: str, fisheye: bool, name: str) -> tuple[float, ...]:
    """Return OpenCV's coefficients. nerfstudio's list of them has another order."""
    known = {
        key: _number(frame, key) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2") if key in frame
    }
    listed = frame.get("distortion_params")
    if listed is not None:
        expect(
            isinstance(listed, list) and len(listed) <= 6, "distortion_params is not a list of six numbers"
        )
        expect(all(map(is_coordinate, listed)), "distortion_params has a value that is not a number")
        known = dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), map(float, listed), strict=False)) | known
    keys = _FISHEYE if fisheye else _PERSPECTIVE[model if model in _PERSPECTIVE else "OPENCV"]
    further = [key for key in known if known[key] and key not in keys]
    if further:
        raise UserError(
            f"photo {name} has a {model} camera with {', '.join(further)}, of another model: undistort it "
            "first"
        )
    found = tuple(known.get(key, 0.0) for key in keys)
    found = found[:4] if len(found) == 5 and not found[4] else found
    return found if fisheye or any(found) else ()


def _number(frame: Mapping[str, Any], key: str) -> float:
    value = frame[key]
    expect(is_coordinate(value), f"its {key} is {str(value)[:40]!r}, not a number")
    return float(value)
