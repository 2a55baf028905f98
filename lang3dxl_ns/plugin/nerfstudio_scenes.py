"""Scenes read by nerfstudio's own dataparsers (transforms.json …): photos, and a model without tracks."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.cameras import lens_of
from lang3dxl_ns.preparation.physical_scale import points_in_view
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto
from lang3dxl_ns.scene.photo import Photo


def photos_of(outputs: DataparserOutputs, data: Path) -> list[Photo]:
    """`Photo`s for the outputs of any nerfstudio dataparser.

    Raises UserError for a camera that is not a perspective camera, and for a photo outside the data folder.
    """
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
    """A reconstruction in the scene's original units from cameras and seed points, for scenes without
    tracks: a photo's points are the seed points that project into it."""
    metadata = splits[0].metadata
    scale = splits[0].dataparser_scale
    points = (
        metadata["points3D_xyz"].double().numpy() / scale if "points3D_xyz" in metadata else np.zeros((0, 3))
    )
    photos = {}
    for outputs in splits:
        for photo, pose in zip(outputs.metadata["photos"], outputs.cameras.camera_to_worlds, strict=True):
            tracked = _tracked(photo, pose.double().numpy(), scale)
            photos[photo.name] = replace(tracked, points=points_in_view(points, tracked))
    colors = metadata["points3D_rgb"].numpy() if len(points) else np.zeros((0, 3))
    return Reconstruction(photos=dict(sorted(photos.items())), points=points, colors=colors)


def _tracked(photo: Photo, world_from_camera: np.ndarray, scale: float) -> TrackedPhoto:
    rotation = (world_from_camera[:, :3] * [1, -1, -1]).T  # OpenGL camera axes to OpenCV's, inverted
    camera_from_world = np.hstack([rotation, -rotation @ world_from_camera[:, 3:] / scale])
    nowhere = np.zeros((0, 3)), np.zeros((0, 2))
    return TrackedPhoto(photo.name, photo.lens, camera_from_world, *nowhere)
