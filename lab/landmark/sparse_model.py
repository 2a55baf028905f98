"""COLMAP model of a demo scene: surface points and tracks that respect visibility, with realistic errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray as Array

from lab.landmark.labels import PART
from lab.landmark.photography import Shot
from lab.landmark.raycast import Camera

POINTS = 24_000
"""Number of candidate points over the whole collection. Those found in too few photos are dropped."""
SHORTEST_TRACK = 3
KEYPOINTS = 2000
"""Upper limit on the visible points found in a photo."""
FOUND = 0.5
"""Largest share of the visible points that is found."""
NOISE = (0.3, 0.7)
"""Range of the standard deviation of each photo's keypoint error, pixels."""
FALSE_MATCHES = 0.015
"""Share of mismatched points, which are tracked in two photos at a wrong position."""


@dataclass(frozen=True, eq=False)
class TakenPhoto:
    """Parts of a photo that the model needs."""

    number: int
    width: int
    height: int
    camera: Camera
    points: Float[Array, "n 3"]
    """Candidate points in the landmark's world, meters."""
    colors: UInt8[Array, "n 3"]


@dataclass(frozen=True, eq=False)
class Similarity:
    """Similarity from the landmark's world to COLMAP's: scale · rotation · x + translation."""

    scale: float
    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]

    @classmethod
    def random(cls, rng: np.random.Generator) -> Similarity:
        """Draw any orientation and position, and a world unit of 3 to 50 m."""
        rotation, triangle = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation = rotation * np.sign(np.diag(triangle))
        rotation[:, 0] *= np.linalg.det(rotation)
        return cls(float(np.exp(rng.uniform(np.log(0.02), np.log(0.3)))), rotation, rng.normal(0, 2, 3))

    def apply(self, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        return self.scale * points @ self.rotation.T + self.translation

    def camera_from_world(self, camera: Camera) -> Float[Array, "3 4"]:
        """Compute the camera's pose in COLMAP's world."""
        rotation = camera.rotation @ self.rotation.T
        center = self.apply(camera.position[None])[0]
        return np.column_stack([rotation, -rotation @ center])


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points with their keypoints, one row per observation."""

    points: Float[Array, "n 3"]
    """Points in the landmark's world, meters."""
    colors: UInt8[Array, "n 3"]
    point: Int[Array, " m"]
    photo: Int[Array, " m"]
    """Index into the photos."""
    pixel: Float[Array, "m 2"]


def sample_points(shot: Shot, camera: Camera, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Sample world points [n, 3] and colors [n, 3] at random pixels of permanent surfaces, at most `count`.

    More are sampled where the picture has contrast, and fewer on the ground. Pixels at silhouettes are
    excluded, because their keypoints would slide along the edge.
    """
    height, width = shot.parts.shape
    lasting = ~np.isin(shot.parts, [PART["sky"], PART["person"], PART["car"]]) & _smooth(shot.depth)
    gray = shot.image.astype(np.float32).mean(axis=2)
    contrast = np.hypot(*np.gradient(gray))
    weight = lasting * (1 + contrast) * np.where(shot.parts == PART["ground"], 0.3, 1.0)
    total = weight.sum()
    if total == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    count = min(count, int(lasting.sum()))
    chosen = rng.choice(weight.size, count, replace=False, p=(weight / total).ravel().astype(np.float64))
    row, column = np.divmod(chosen, width)
    focal = camera.focal * max(width, height)
    x, y = (column + 0.5 - width / 2) / focal, (row + 0.5 - height / 2) / focal
    ray = np.stack([x, y, np.ones(count)], axis=1)
    points = (ray * shot.depth[row, column, None]) @ camera.rotation + camera.position
    return points, shot.image[row, column]


def find_tracks(photos: Sequence[TakenPhoto], depths: Sequence[Path], rng: np.random.Generator) -> Tracks:
    """Match every candidate in every photo that sees it. `depths` are the photos' depth maps (.npy)."""
    points = np.concatenate([photo.points for photo in photos])
    colors = np.concatenate([photo.colors for photo in photos])
    origin = np.repeat(np.arange(len(photos)), [len(photo.points) for photo in photos])
    rows = []
    for i, (photo, path) in enumerate(zip(photos, depths, strict=True)):
        projected = photo.camera.project(points, photo.width, photo.height)
        seen = np.flatnonzero(_visible(projected, np.load(path)))
        luck = rng.random(len(seen)) + (origin[seen] == i)  # points are always found where they were sampled
        found = min(KEYPOINTS, int(FOUND * len(seen)) + len(photo.points))
        seen = np.sort(seen[np.argsort(-luck, kind="stable")[:found]])
        noise = rng.normal(0, rng.uniform(*NOISE), (len(seen), 2))
        rows.append((seen, np.full(len(seen), i), projected[seen, :2] + noise))
    point, photo_index, pixel = (np.concatenate(column) for column in zip(*rows, strict=True))
    long = np.bincount(point, minlength=len(points)) >= SHORTEST_TRACK
    kept = long[point]
    renumbered = np.cumsum(long) - 1
    tracks = Tracks(points[long], colors[long], renumbered[point[kept]], photo_index[kept], pixel[kept])
    return _with_mistakes(tracks, photos, rng)


def _smooth(depth: Float[Array, "h w"]) -> Bool[Array, "h w"]:
    """Return where depth changes little to all four neighbors; false at the border."""
    smooth = np.zeros(depth.shape, bool)
    finite = np.where(np.isfinite(depth), depth, 1e6)
    middle = finite[1:-1, 1:-1]
    neighbors = finite[:-2, 1:-1], finite[2:, 1:-1], finite[1:-1, :-2], finite[1:-1, 2:]
    smooth[1:-1, 1:-1] = np.all([np.abs(n - middle) < 0.02 * middle for n in neighbors], axis=0)
    return smooth


def _visible(projected: Float[Array, "n 3"], depth: Float[Array, "h w"]) -> Bool[Array, " n"]:
    """Return which points are inside the photo and not occluded."""
    height, width = depth.shape
    x, y, z = projected.T
    visible = (z > 0) & (x >= 1) & (y >= 1) & (x < width - 1) & (y < height - 1)
    inside = np.flatnonzero(visible)
    shown = depth[y[inside].astype(int), x[inside].astype(int)].astype(np.float64)
    visible[inside] = np.abs(shown - z[inside]) < 0.01 * z[inside]
    return visible


def _with_mistakes(tracks: Tracks, photos: Sequence[TakenPhoto], rng: np.random.Generator) -> Tracks:
    """Displace points as if they were triangulated from noisy keypoints, and add some false matches."""
    order = np.lexsort((tracks.photo, tracks.point))
    point, photo, pixel = tracks.point[order], tracks.photo[order], tracks.pixel[order].copy()
    lengths = np.bincount(point, minlength=len(tracks.points))
    first = np.cumsum(lengths) - lengths
    focals = np.array([p.camera.focal * max(p.width, p.height) for p in photos])
    places = np.array([p.camera.position for p in photos])
    pixel_sizes = np.linalg.norm(tracks.points[point] - places[photo], axis=1) / focals[photo]
    spread = np.mean(NOISE) * np.minimum.reduceat(pixel_sizes, first) / np.sqrt(lengths)
    points = tracks.points + spread[:, None] * rng.normal(0, 1, tracks.points.shape)

    # A false match lies on the first photo's ray at a random depth where a second photo also has a surface.
    false = np.flatnonzero(rng.random(len(points)) < FALSE_MATCHES)
    depth = np.exp(rng.normal(0, 0.5, len(false)))[:, None]
    seen_from = places[photo[first[false]]]
    points[false] = seen_from + depth * (tracks.points[false] - seen_from)
    keep = np.ones(len(point), bool)
    for i in false:
        second = first[i] + 1
        other = photos[photo[second]]
        x, y, z = other.camera.project(points[i][None], other.width, other.height)[0]
        keep[second + 1 : first[i] + lengths[i]] = False
        if z > 0 and 0 < x < other.width and 0 < y < other.height:
            pixel[second] = x, y
        else:  # no photo agrees, so the point keeps its true position
            points[i] = tracks.points[i]
    return Tracks(points, tracks.colors, point[keep], photo[keep], pixel[keep])


def write_model(
    folder: Path, photos: Sequence[TakenPhoto], tracks: Tracks, similarity: Similarity, one_camera: bool
) -> None:
    """Write cameras.bin, images.bin and points3D.bin (and COLMAP's rigs.bin, frames.bin) to `folder`. Photos
    are named NNNN.jpg, with NNNN as COLMAP image number. With `one_camera`, all share the first photo's
    camera."""
    from lang3dxl_ns.scene.colmap import load_pycolmap  # not in the processes that take photos

    pycolmap = load_pycolmap()
    model = pycolmap.Reconstruction()
    elements: list[list[tuple[int, int]]] = [[] for _ in tracks.points]
    order = np.argsort(tracks.photo, kind="stable")
    starts = np.searchsorted(tracks.photo[order], np.arange(len(photos) + 1))
    for i, photo in enumerate(photos):
        camera_id = 1 if one_camera else photo.number
        if not model.exists_camera(camera_id):
            width, height = photo.width, photo.height
            pinhole = [photo.camera.focal * max(width, height), width / 2, height / 2]
            camera = pycolmap.Camera(
                model="SIMPLE_PINHOLE", width=width, height=height, params=pinhole, camera_id=camera_id
            )
            model.add_camera_with_trivial_rig(camera)
        own = order[starts[i] : starts[i + 1]]
        image = pycolmap.Image(
            name=f"{photo.number:04d}.jpg",
            keypoints=tracks.pixel[own].reshape(-1, 2),
            camera_id=camera_id,
            image_id=photo.number,
        )
        pose = similarity.camera_from_world(photo.camera)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for keypoint, point in enumerate(tracks.point[own].tolist()):
            elements[point].append((photo.number, keypoint))
    places = similarity.apply(tracks.points)
    for xyz, color, observations in zip(places, tracks.colors, elements, strict=True):
        track = pycolmap.Track()
        for number, keypoint in observations:
            track.add_element(number, keypoint)
        model.add_point3D(xyz, track, color)
    model.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
