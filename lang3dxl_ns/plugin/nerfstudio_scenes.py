"""Scenes of nerfstudio's own dataparsers: check of a transforms.json, photos, models without tracks."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from lang3dxl_ns.common.checks import expect, is_coordinate
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import check_regular, expanded, read_json
from lang3dxl_ns.plugin.cameras import lens_of
from lang3dxl_ns.preparation.physical_scale import points_in_view
from lang3dxl_ns.scene.camera import Lens, check_pose, view_matrix
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto
from lang3dxl_ns.scene.companions import inside
from lang3dxl_ns.scene.photo import Photo

_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4")
_PATHS = ("file_path", "mask_path", "depth_file_path")
_NAMES = ("train_filenames", "val_filenames", "test_filenames")
_MOST_BYTES = 1 << 30
_NONE = np.zeros((0, 3))
_MOST_POINTS = 5_000
"""Evenly spaced seed points of which each photo keeps those in its view; more tell no more of distances."""


def check_transforms(dataparser: DataParserConfig) -> None:
    """Check the transforms.json of a scene as COLMAP models are checked, before nerfstudio reads it. Raises
    UserError for a file that is not JSON or lists no photo, an impossible lens or pose, an unknown camera
    model, and a path that leads out of the scene's folder, also through a link inside it. (A folder in the
    scene's may be a link itself, such as images/.) Scenes of other dataparsers are not checked."""
    if not isinstance(dataparser, NerfstudioDataParserConfig):
        return
    data = expanded(dataparser.data)
    path = data if data.suffix == ".json" else data / "transforms.json"
    try:
        content = read_json(path, _MOST_BYTES)
        _check_scene(content, path.parent)
    except FileNotFoundError as error:
        raise UserError(f"there is no {path}: give its folder as --data, or the file itself") from error
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        reason = f"a photo has no {error}, as in instant-ngp's form" if isinstance(error, KeyError) else error
        raise UserError(f"{path} can't be used: {reason}; correct it, or make it again") from error
    if "ply_file_path" not in content and not (path.parent / "colmap").exists():
        say(
            f"{path} names no points (ply_file_path): training starts from random ones, which costs "
            "several dB; without this file, the photos are reconstructed with points"
        )


def _check_scene(content: Any, folder: Path) -> None:
    frames: Any = content.get("frames") if isinstance(content, dict) else None
    expect(isinstance(frames, list) and bool(frames), "it lists no photo under frames")
    model = content.get("camera_model", "OPENCV")
    known = isinstance(model, str) and model in CAMERA_MODEL_TO_TYPE
    expect(known, f"the camera model {str(model)[:40]!r} is unknown")
    for frame in frames:
        expect(isinstance(frame, dict), "a photo is not described by names and values")
        name = str(frame["file_path"])[:80]
        try:
            _check_frame({**content, **frame}, folder)
        except (ValueError, TypeError) as error:
            raise ValueError(f"photo {name}: {error}") from error
    for path in (content.get("ply_file_path"), *(n for key in _NAMES for n in content.get(key, ()))):
        if path is not None:
            _check_path(path, folder)
    if "applied_transform" in content:
        check_pose(content["applied_transform"])
    scale = content.get("applied_scale", 1.0)
    expect(is_coordinate(scale) and scale > 0, f"applied_scale is {str(scale)[:40]}")


def _check_frame(frame: dict[str, Any], folder: Path) -> None:
    for name in (frame[key] for key in _PATHS if key in frame):
        _check_path(name, folder)
    width, height, *focal = (frame[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"))
    expect(is_coordinate(width) and is_coordinate(height), "its size is not a number")
    distortion = [frame[key] for key in _DISTORTION if key in frame]
    numbers = all(map(is_coordinate, (*distortion, *frame.get("distortion_params", ()))))
    expect(numbers, "its lens has a distortion that is not a number")
    Lens(int(width), int(height), *focal).check()
    check_pose(frame["transform_matrix"])
    expect(Path(frame["file_path"]).suffix != "", "its name lacks the suffix, such as .jpg: add it")
    expect(len(frame["transform_matrix"]) == 4, "its pose has 3 rows: add the row 0, 0, 0, 1")
    expect(not frame.get("is_fisheye"), "is_fisheye is not read: set camera_model OPENCV_FISHEYE instead")


def _check_path(name: object, folder: Path) -> None:
    """Check a path as `inside` does; but folders of the scene may be links, as for large photos."""
    if not isinstance(name, str):
        raise ValueError(f"{str(name)[:40]!r} is not a path")
    path = folder / name
    if Path(name).is_absolute():
        within = Path(os.path.normpath(path)).is_relative_to(os.path.normpath(folder.absolute()))
        expect(within, f"{name} lies outside {folder}: copy it there, and name it relative to it")
        name = os.path.relpath(path, folder.absolute())
    try:
        inside(folder, name, follow_links=True)
        top, *below = Path(name).parts
        inside(folder / top if below else folder, os.path.join(*below) if below else top)
    except UserError as error:
        raise ValueError(str(error)) from error
    if path.exists():
        check_regular(path)


def photos_of(outputs: DataparserOutputs, data: Path) -> list[Photo]:
    """Build `Photo`s for the outputs of any nerfstudio dataparser. Raises UserError for a camera that is not
    a perspective camera, and for a photo outside the data folder."""
    cameras, folder = outputs.cameras, data if data.is_dir() else data.parent
    photos = []
    for i, path in enumerate(outputs.image_filenames):
        kind = CameraType(int(cameras.camera_type[i]))
        if kind is not CameraType.PERSPECTIVE:
            raise UserError(
                f"photo {path} has a {kind.name.lower()} camera, not undistorted by nerfstudio-data: leave "
                "nerfstudio-data off, so that the COLMAP model is read (ns-process-data keeps it in "
                "colmap/sparse/0) and photos are undistorted; panoramas must first be split "
                "(ns-process-data images --camera-type equirectangular)"
            )
        if not Path(os.path.normpath(path)).is_relative_to(os.path.normpath(folder)):
            raise UserError(
                f"photo {path} lies outside {folder}: copy it there, and name it in the scene's file "
                "relative to that folder"
            )
        photos.append(
            Photo(
                name=path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name,
                path=path,
                mask_path=outputs.mask_filenames[i] if outputs.mask_filenames else None,
                lens=lens_of(cameras, i),
            )
        )
    return photos


def reconstruction_of(splits: list[DataparserOutputs]) -> Reconstruction:
    """Build a reconstruction in the scene's original units from cameras and seed points, for scenes without
    tracks. A photo's points are those of at most 5,000 seed points that project into it."""
    scale, metadata, points, colors = splits[0].dataparser_scale, splits[0].metadata, _NONE, _NONE
    if "points3D_xyz" in metadata:
        points = metadata["points3D_xyz"].double().numpy() / scale
        colors = metadata["points3D_rgb"].numpy() if len(points) else colors
    photos, some_points = {}, points[:: -(-len(points) // _MOST_POINTS) or 1]
    for outputs in splits:
        poses = outputs.cameras.camera_to_worlds.double()
        for photo, pose in zip(outputs.metadata["photos"], poses, strict=True):
            camera_from_world = view_matrix(pose)[:3].numpy()
            camera_from_world[:, 3] /= scale
            tracked = TrackedPhoto(photo.name, photo.lens, camera_from_world, _NONE, _NONE[:, :2])
            photos[photo.name] = replace(tracked, points=points_in_view(some_points, tracked))
    return Reconstruction(dict(sorted(photos.items())), points, colors)
