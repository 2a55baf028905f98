"""Crop sizes in world units: how much of the building a pixel shows, and which crop sides follow.

Everything here is in the units of the original COLMAP model. Poses that a trainer has recentred and rescaled
don't belong here: the scale ranges would lose their meaning.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np  # before pycolmap: the other way round, Pillow's PNG writer aborts the process
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.preparation.model_files import check_binary_model

if TYPE_CHECKING:
    import pycolmap

DistanceRule = Literal["median", "mean", "mean-inner"]
AngleRule = Literal["half", "paper", "exact"]

PERSPECTIVE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE_MODELS = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
"""COLMAP's camera models whose distortion is OpenCV's, with the parameters in OpenCV's order."""

SMALLEST_CROP = 32
"""Pixels: an image encoder sees nothing in smaller crops."""
EDGE_MARGIN = 0.1
"""Fraction of a side: observations nearer to the photo's edge don't count for the "mean-inner" distance."""


@dataclass(frozen=True, eq=False)
class PhotoGeometry:
    """A photo's camera and the 3D points tracked in it.

    Pixels are those of a `width` × `height` photo, origin at the corner of the top-left pixel. The camera
    frame is COLMAP's (x right, y down, z forward).
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]
    """OpenCV's order: k1 k2 p1 p2 [k3 …], or k1 k2 k3 k4 of a fisheye camera; empty without distortion."""
    fisheye: bool
    camera_from_world: Float[Array, "3 4"]
    points: Float[Array, "n 3"]
    pixels: Float[Array, "n 2"]

    @property
    def centre(self) -> Float[Array, "3"]:
        """The camera's position in the world."""
        return -self.camera_from_world[:, :3].T @ self.camera_from_world[:, 3]

    def resized(self, width: int, height: int) -> PhotoGeometry:
        """The same photo with another number of pixels."""
        x, y = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * x,
            fy=self.fy * y,
            cx=self.cx * x,
            cy=self.cy * y,
            pixels=self.pixels * [x, y],
        )


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A COLMAP model: its photos, sorted by name, and its points with their colours."""

    photos: dict[str, PhotoGeometry]
    points: Float[Array, "m 3"]
    colours: UInt8[Array, "m 3"]


@dataclass(frozen=True)
class ScaleRange:
    """Sides of the smallest and the largest crop in world units, and in one sentence where they come from."""

    smallest: float
    largest: float
    reason: str


def read_reconstruction(model_dir: Path) -> Reconstruction:
    """Read a COLMAP model (.bin or .txt) with its tracks.

    Raises UserError for a folder without a model, a damaged or empty model, and a camera model that OpenCV
    can't undistort.
    """
    model = _read_model(Path(model_dir))
    images = sorted(
        (image for image in model.images.values() if image.has_pose), key=lambda image: image.name
    )
    if not images:
        raise UserError(f"the COLMAP model in {model_dir} has no photo with a pose: run the mapper again")
    points = {i: point for i, point in model.points3D.items() if np.isfinite(point.xyz).all()}
    positions = {i: point.xyz for i, point in points.items()}
    return Reconstruction(
        photos={
            image.name: _photo_geometry(image, model.cameras[image.camera_id], positions) for image in images
        },
        points=np.array(list(positions.values()), dtype=np.float64).reshape(-1, 3),
        colours=np.array([point.color for point in points.values()], dtype=np.uint8).reshape(-1, 3),
    )


def photos_in_model(model_dir: Path) -> int:
    """How many photos a COLMAP model has, without reading it: its images file begins with, or lists, them."""
    binary, text = model_dir / "images.bin", model_dir / "images.txt"
    if binary.is_file():
        with binary.open("rb") as file:
            return int.from_bytes(file.read(8), "little")
    with text.open(errors="replace") as lines:
        return sum(not line.startswith("#") for line in lines) // 2  # a line of keypoints follows each


def points_in_view(points: Float[Array, "m 3"], photo: PhotoGeometry) -> Float[Array, "k 3"]:
    """The points in front of the camera that project into the (undistorted) photo, hidden ones included."""
    return _track_all_in_view(points, photo).points


def pixel_size(
    photo: PhotoGeometry, distance: DistanceRule = "median", angle: AngleRule = "half"
) -> float | None:
    """World units that a pixel of the photo shows at the distance of its tracked points.

    distance: "median" is the camera's distance to the points' median (per axis of the camera), robust
    against outliers;
    "mean" to their mean; "mean-inner" to the mean without the points near the photo's edges (the paper).
    angle: "half" is 2 d tan(θ/2) with θ the full field of view over the pixels, which the published scale
    ranges belong to; "paper" is the paper's text, 2 d tan θ with θ = arctan(W / f) / W; "exact" the pinhole's
    d / f. Width and height versions are averaged.

    None when the photo has no tracked points in front of the camera. Method: Lang3D-XL, physical scale.
    """
    d = _subject_distance(photo, distance)
    if d is None:
        return None
    return (_footprint(photo.width, photo.fx, d, angle) + _footprint(photo.height, photo.fy, d, angle)) / 2


def pixel_sizes(
    reconstruction: Reconstruction, distance: DistanceRule = "median", angle: AngleRule = "half"
) -> tuple[dict[str, float], list[str]]:
    """Pixel size of every photo, and the names of those that have it from a fallback.

    A photo without tracked points is measured by the points in its view, and without those has the median of
    the other photos. Raises UserError when no photo can be measured.
    """
    photos = reconstruction.photos
    sizes = {name: pixel_size(photo, distance, angle) for name, photo in photos.items()}
    untracked = [name for name, size in sizes.items() if size is None]
    for name in untracked:
        sizes[name] = pixel_size(_track_all_in_view(reconstruction.points, photos[name]), distance, angle)
    known = [size for size in sizes.values() if size is not None]
    if not known:
        raise UserError(
            f"no photo sees a 3D point ({len(sizes)} photos, {len(reconstruction.points)} points): "
            "sizes in the world are unknown. Triangulate (colmap point_triangulator) or use relative scales"
        )
    median = float(np.median(known))
    return {name: median if size is None else size for name, size in sizes.items()}, untracked


def physical_scales(smallest: float, largest: float) -> list[float]:
    """Crop sides in world units, geometric from `smallest` to `largest`, both included.

    There are round(log_√2(largest / smallest)) of them, at least 1 (then the smallest alone). Raises
    UserError for an empty range. Method: Lang3D-XL, scale list.
    """
    if not 0 < smallest <= largest < math.inf:
        raise UserError(
            f"scale range {smallest}–{largest} is empty: give 0 < smallest ≤ largest, in world units"
        )
    count = max(1, round(2 * (math.log2(largest) - math.log2(smallest))))
    return np.geomspace(smallest, largest, count).tolist()


def relative_scales(
    count: int = 7,
    smallest: float = 0.05,
    largest: float = 0.5,
    spacing: Literal["geometric", "linear"] = "geometric",
) -> list[float]:
    """Crop sides as fractions of the photo's width, as LERF has them ("linear" is its own spacing)."""
    space = np.geomspace if spacing == "geometric" else np.linspace
    return space(smallest, largest, count).tolist()


def crop_sides(scales: Sequence[float], pixel_size: float, width: int) -> tuple[list[int], list[float]]:
    """Crop sides in pixels of a photo of `width` pixels, and their sizes in world units after clipping.

    Sides are clipped to 32 … `width` pixels; of those that become equal the first stays, so that a photo can
    have fewer crops than there are scales. For relative scales the pixel size is 1 / width.
    """
    sizes: dict[int, float] = {}
    for scale in sorted(scales):
        side = min(max(scale / pixel_size, SMALLEST_CROP), width)
        sizes.setdefault(math.floor(side + 1e-6), side * pixel_size)  # 0.47 / 0.01 is 46.99…
    return list(sizes), list(sizes.values())


def propose_scale_range(reconstruction: Reconstruction, pixel_sizes: dict[str, float]) -> ScaleRange:
    """A scale range for a scene nobody has measured by hand, from what its photos see.

    The smallest crop is 1/20 of what the median photo sees across, about a window on a building that fills
    the photo, and at least 32 pixels there. The largest is half of what the wider photos see, but no larger
    than the building (the sphere that holds 80 % of the points). Their ratio stays within that of the
    published hand-made ranges, 4.5–16.
    """
    widths = np.array([photo.width for photo in reconstruction.photos.values()])
    sizes = np.array([pixel_sizes[name] for name in reconstruction.photos])
    typical, wide = np.quantile(widths * sizes, [0.5, 0.75])
    building = _extent(reconstruction.points)
    smallest = float(max(typical / 20, SMALLEST_CROP * np.median(sizes)))
    largest = float(np.clip(min(wide / 2, building), 4.5 * smallest, 16 * smallest))
    reason = (
        f"crops of {smallest:.3g}–{largest:.3g} world units: the median photo sees {typical:.3g} across "
        f"({smallest / np.median(sizes):.0f} pixels make the smallest crop), a quarter of the photos "
        f"{wide:.3g} or more, and the building measures about {building:.3g}"
    )
    return ScaleRange(smallest, largest, reason)


def _extent(points: Float[Array, "m 3"]) -> float:
    """Diameter of the sphere around the median point that holds 80 % of the points."""
    return 2 * float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.8))


def _subject_distance(photo: PhotoGeometry, rule: DistanceRule) -> float | None:
    """Distance from the camera to the middle of its tracked points; None without a usable one.

    In the camera's frame: the per-axis median of a world that is turned would be another point. What is
    behind the camera can't be seen: such a track is wrong, and doesn't count.
    """
    points = (photo.points - photo.centre) @ photo.camera_from_world[:, :3].T
    in_front = points[:, 2] > 0
    points = points[in_front]
    if rule == "mean-inner":
        size = np.array([photo.width, photo.height])
        inner = (np.abs(photo.pixels[in_front] / size - 0.5) < 0.5 - EDGE_MARGIN).all(axis=1)
        points = points[inner] if inner.any() else points
    if not len(points):
        return None
    middle = np.median(points, axis=0) if rule == "median" else points.mean(axis=0)
    d = float(np.linalg.norm(middle))
    return d if 0 < d < math.inf else None


def _footprint(length: int, focal: float, distance: float, rule: AngleRule) -> float:
    """World units per pixel along an axis of `length` pixels."""
    if rule == "exact":
        return distance / focal
    if rule == "paper":
        return 2 * distance * math.tan(math.atan(length / focal) / length)
    return 2 * distance * math.tan(math.atan(length / (2 * focal)) / length)


def _track_all_in_view(points: Float[Array, "m 3"], photo: PhotoGeometry) -> PhotoGeometry:
    """The photo with the points in its view in place of its tracked ones."""
    x, y, z = photo.camera_from_world @ np.column_stack([points, np.ones(len(points))]).T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels = np.column_stack([photo.fx * x / z + photo.cx, photo.fy * y / z + photo.cy])
    inside = (z > 0) & ((pixels >= 0) & (pixels <= [photo.width, photo.height])).all(axis=1)
    return replace(photo, points=points[inside], pixels=pixels[inside])


def _read_model(folder: Path) -> pycolmap.Reconstruction:
    """pycolmap's model, with the reasons why there is none in words."""
    import pycolmap

    parts = ("cameras", "images", "points3D")
    if not any(all((folder / (part + ending)).is_file() for part in parts) for ending in (".bin", ".txt")):
        raise UserError(
            f"no COLMAP model in {folder}: looked for cameras, images and points3D, .bin or .txt. Give the "
            "folder that holds them (usually sparse/0), or make one: "
            "colmap automatic_reconstructor --workspace_path SCENE --image_path SCENE/images"
        )
    check_binary_model(folder)
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, IndexError, RuntimeError, UnicodeDecodeError, MemoryError) as error:
        raise UserError(f"the COLMAP model in {folder} is damaged, copy or make it again: {error}") from error


def _photo_geometry(
    image: pycolmap.Image, camera: pycolmap.Camera, positions: dict[int, Array]
) -> PhotoGeometry:
    fx, fy = camera.focal_length_x, camera.focal_length_y
    if min(camera.width, camera.height, fx, fy) <= 0 or not np.isfinite(camera.params).all():
        raise UserError(f"photo {image.name} has an impossible camera, remove it from the model: {camera}")
    distortion, fisheye = _distortion(image.name, camera)
    tracked = [point for point in image.get_observation_points2D() if point.point3D_id in positions]
    return PhotoGeometry(
        name=image.name,
        width=camera.width,
        height=camera.height,
        fx=fx,
        fy=fy,
        cx=camera.principal_point_x,
        cy=camera.principal_point_y,
        distortion=distortion,
        fisheye=fisheye,
        camera_from_world=image.cam_from_world().matrix(),
        points=np.array([positions[point.point3D_id] for point in tracked], dtype=np.float64).reshape(-1, 3),
        pixels=np.array([point.xy for point in tracked], dtype=np.float64).reshape(-1, 2),
    )


def _distortion(name: str, camera: pycolmap.Camera) -> tuple[tuple[float, ...], bool]:
    """OpenCV's coefficients of the photo's COLMAP camera, and whether it is a fisheye."""
    model = camera.model_name
    coefficients = tuple(camera.params[camera.extra_params_idxs()].tolist())
    coefficients += (0.0,) * (4 - len(coefficients))
    if model in PERSPECTIVE_MODELS:
        return coefficients if any(coefficients) else (), False
    if model in FISHEYE_MODELS:
        return coefficients, True
    raise UserError(
        f"photo {name} has a {model} camera, which can't be undistorted here: "
        "run colmap image_undistorter and use its images and model"
    )
