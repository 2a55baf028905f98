"""Captures of scenes that nerfstudio's other dataparsers read: their photos, and models without tracks."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from numpy import ndarray as Array

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.plugin.cameras import lens_of
from lang3dxl_ns.preparation.physical_scale import points_in_view
from lang3dxl_ns.scene.camera import view_matrix
from lang3dxl_ns.scene.capture import Capture, Split
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto
from lang3dxl_ns.scene.frame import Frame
from lang3dxl_ns.scene.photo import Photo

_NONE = np.zeros((0, 3))
_MOST_POINTS = 5_000
"""Evenly spaced seed points of which each photo keeps those in its view; more tell no more of distances."""


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


def capture_of(train: DataparserOutputs, held_out: DataparserOutputs, data: Path) -> Capture:
    """Build the capture of a scene from any dataparser's outputs of both splits. A photo's points are those
    of at most 5,000 seed points that project into it. Raises UserError as `photos_of` does, and for a split
    without photos."""
    frame = Frame(train.dataparser_transform.double().numpy(), float(train.dataparser_scale))
    turn, shift = np.linalg.inv(frame.transform[:, :3]), frame.transform[:, 3]

    def original(points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        return (points / frame.scale - shift) @ turn.T

    points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if "points3D_xyz" in train.metadata and len(train.metadata["points3D_xyz"]):
        points = original(train.metadata["points3D_xyz"].double().numpy())
        colors = train.metadata["points3D_rgb"].numpy()
    photos, tracked, some_points = dict[str, Photo](), {}, points[:: -(-len(points) // _MOST_POINTS) or 1]
    names = []
    for outputs in (train, held_out):
        found = outputs.metadata.get("photos") or photos_of(outputs, data)
        if not found:
            raise UserError(f"a split of {data} has no photo: add photos (a tenth is held out)")
        names.append(tuple(photo.name for photo in found))
        photos |= {photo.name: photo for photo in found}
        poses = outputs.cameras.camera_to_worlds.double().numpy()
        world = np.concatenate([turn @ poses[:, :, :3], original(poses[:, :, 3])[..., None]], axis=2)
        for photo, pose in zip(found, torch.from_numpy(world), strict=True):
            seen = TrackedPhoto(photo.name, photo.lens, view_matrix(pose)[:3].numpy(), _NONE, _NONE[:, :2])
            tracked[photo.name] = replace(seen, points=points_in_view(some_points, seen))
    model = Reconstruction(dict(sorted(tracked.items())), points, colors)
    folder = expanded(data if data.is_dir() else data.parent).absolute()
    return Capture(folder, list(photos.values()), model, known_split=Split(*names), known_frame=frame)
