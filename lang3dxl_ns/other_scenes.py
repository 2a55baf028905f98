"""Scenes of nerfstudio's own dataparsers (transforms.json …): photos, and a model without tracks."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.preparation.photo import Photo
from lang3dxl_ns.preparation.physical_scale import PhotoGeometry, Reconstruction, points_in_view


def photos_of(outputs: DataparserOutputs, data: Path) -> list[Photo]:
    """`Photo`s for the outputs of any of nerfstudio's dataparsers.

    Raises UserError for a camera that is no perspective one, and for a photo outside the data folder.
    """
    cameras, folder = outputs.cameras, data if data.is_dir() else data.parent
    photos = []
    for i, path in enumerate(outputs.image_filenames):
        kind = CameraType(int(cameras.camera_type[i]))
        if kind is not CameraType.PERSPECTIVE:
            raise UserError(
                f"photo {path} has a {kind.name.lower()} camera, which is not undistorted on this way: leave "
                "nerfstudio-data off, so that the COLMAP model is read (ns-process-data keeps it in "
                "colmap/sparse/0) and photos are undistorted; panoramas must be cut up first "
                "(ns-process-data images --camera-type equirectangular)"
            )
        if not Path(os.path.normpath(path)).is_relative_to(os.path.normpath(folder)):
            raise UserError(
                f"photo {path} lies outside {folder}: copy it there, and name it in the scene's file "
                "relative to that folder"
            )
        k1, k2, k3, _, p1, p2 = (
            cameras.distortion_params[i].tolist() if cameras.distortion_params is not None else [0.0] * 6
        )
        photos.append(
            Photo(
                name=path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name,
                path=path,
                mask_path=outputs.mask_filenames[i] if outputs.mask_filenames else None,
                width=int(cameras.width[i]),
                height=int(cameras.height[i]),
                fx=float(cameras.fx[i]),
                fy=float(cameras.fy[i]),
                cx=float(cameras.cx[i]),
                cy=float(cameras.cy[i]),
                distortion=(k1, k2, p1, p2, k3) if any((k1, k2, k3, p1, p2)) else (),
            )
        )
    return photos


def reconstruction_of(splits: list[DataparserOutputs]) -> Reconstruction:
    """A reconstruction in the scene's original units made of cameras and seed points, for scenes that
    come without tracks: a photo's points are the seed points that project into it."""
    metadata = splits[0].metadata
    scale = splits[0].dataparser_scale
    points = (
        metadata["points3D_xyz"].double().numpy() / scale if "points3D_xyz" in metadata else np.zeros((0, 3))
    )
    photos = {}
    for outputs in splits:
        for photo, pose in zip(outputs.metadata["photos"], outputs.cameras.camera_to_worlds, strict=True):
            geometry = _geometry(photo, pose.double().numpy(), scale)
            photos[photo.name] = replace(geometry, points=points_in_view(points, geometry))
    colours = metadata["points3D_rgb"].numpy() if len(points) else np.zeros((0, 3))
    return Reconstruction(photos=dict(sorted(photos.items())), points=points, colours=colours)


def _geometry(photo: Photo, world_from_camera: np.ndarray, scale: float) -> PhotoGeometry:
    rotation = (world_from_camera[:, :3] * [1, -1, -1]).T  # OpenGL camera axes to OpenCV's, inverted
    camera_from_world = np.hstack([rotation, -rotation @ world_from_camera[:, 3:] / scale])
    return PhotoGeometry(
        name=photo.name,
        width=photo.width,
        height=photo.height,
        fx=photo.fx,
        fy=photo.fy,
        cx=photo.cx,
        cy=photo.cy,
        distortion=photo.distortion,
        fisheye=False,
        camera_from_world=camera_from_world,
        points=np.zeros((0, 3)),
        pixels=np.zeros((0, 2)),
    )
