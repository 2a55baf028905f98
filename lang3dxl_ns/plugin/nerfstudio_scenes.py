"""Scenes of nerfstudio's other dataparsers: their photos, and models without tracks."""

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
from lang3dxl_ns.scene.camera import view_matrix
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto
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
