"""Synthetic collection of any number of photos with a COLMAP model, made in seconds for benchmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from PIL import Image

from lang3dxl_ns.scene.colmap import load_pycolmap

SIZES = ((160, 120), (120, 160), (200, 150), (240, 160), (180, 180))
"""Width and height of the photos, used in turn."""


def write_crowd(folder: Path, photos: int, points: int, seed: int = 0, zoom: int = 1) -> Path:
    """Write `photos` JPEGs of smooth noise on a ring around a ball of `points` 3D points; returns `folder`.

    Every photo has a camera of its own size and tracks up to 60 points. Deterministic for a seed. zoom:
    factor of all sizes; 20 makes photos of 8 to 15 megapixels.
    """
    pycolmap = load_pycolmap()
    rng = np.random.default_rng(seed)
    ball = rng.normal(size=(points, 3))
    ball *= rng.uniform(0.2, 1, (points, 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
    model = pycolmap.Reconstruction()
    cameras = []
    for i, (width, height) in enumerate((zoom * width, zoom * height) for width, height in SIZES):
        focal = 1.1 * max(width, height)
        parameters = [focal, focal, width / 2, height / 2]
        cameras.append(
            pycolmap.Camera(camera_id=i + 1, model="PINHOLE", width=width, height=height, params=parameters)
        )
        model.add_camera_with_trivial_rig(cameras[-1])
    (folder / "images").mkdir(parents=True)
    tracks: dict[int, list[tuple[int, int]]] = {}
    for i in range(photos):
        camera, name = cameras[i % len(cameras)], f"{i:05d}.jpg"
        _noise(rng, camera.width, camera.height).save(folder / "images" / name, quality=85)
        pose = _pose(2 * np.pi * i / photos, distance=rng.uniform(3, 5))
        chosen = rng.choice(points, min(60, points), replace=False)
        pixels = camera.img_from_cam(ball[chosen] @ pose[:, :3].T + pose[:, 3])
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        for place, point in enumerate(chosen[inside].tolist()):
            tracks.setdefault(point, []).append((i + 1, place))
        image = pycolmap.Image(
            name=name, keypoints=pixels[inside], camera_id=camera.camera_id, image_id=i + 1
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    colors = rng.integers(40, 215, (points, 3), dtype=np.uint8)
    for point in range(points):
        track = pycolmap.Track()
        for image_id, place in tracks.get(point, []):
            track.add_element(image_id, place)
        model.add_point3D(ball[point], track, colors[point])
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")
    return folder


def _noise(rng: np.random.Generator, width: int, height: int) -> Image.Image:
    """Smooth noise that compresses like photos, to about a tenth of the raw size."""
    coarse = rng.integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
    return Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC)


def _pose(angle: float, distance: float) -> Float[Array, "3 4"]:
    """World-to-camera pose on a ring, looking at the center."""
    position = distance * np.array([np.sin(angle), -np.cos(angle), 0.3])
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ position])
