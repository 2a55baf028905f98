"""Photos on a page: their cameras, small pictures of them, and what the overview shows besides its photo."""

from __future__ import annotations

import io
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.scene.camera import in_camera_frame
from lang3dxl_ns.scene.photo_folder import find_photos
from lang3dxl_ns.scene.record import SCENE_FILE, ScenePhoto, SceneRecord
from lang3dxl_ns.web.pack import camera_json

PHOTO_SIDE, _QUALITY = 720, 80
"""Longer side in pixels of a page's photos, and quality of their JPEGs."""
MOST_CAMERAS = 400
"""Most photos whose cameras a page knows; evenly spaced ones are kept."""
_ROOM = 1.06
"""Room around what the overview shows besides its photo."""
_CUT, _WIDER, _STEEP, _BEHIND, _LARGE = 0.0003, 2.0, 0.9, 1.5, 3.0
"""Share of what a scene's views show that may lie beyond each side of the overview; how much farther than its
photo an overview reaches, and up to which slope; how much farther than the middle of the scene what it shows
may lie; and how much larger than most a Gaussian is that shows sky or ground."""


def photo_json(photo: ScenePhoto, address: str | None) -> dict[str, Any]:
    """Describe a photo for the page: its undistorted camera, the lens and size of its file, in whose pixels
    marks count, and the address of its small picture, if there is one."""
    width, height = photo.file_size
    lens = photo.lens.resized(width, height)
    numbers = [lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion] if lens.distorts else None
    told = {"name": photo.name, "photo": address, "doubtful": photo.doubtful, "file": [width, height]}
    return {**told, "distortion": numbers, "fisheye": lens.fisheye, **camera_json(photo.full_camera)}


def small_photo(photo: ScenePhoto, folder: Path) -> bytes:
    """Read a photo of a folder (which may hold images/) as its pinhole camera sees it, as a small JPEG.
    Raises UserError if it is missing or damaged."""
    places = [find_photos(folder).folder, folder]
    found = next((place for place in places if (place / photo.name).is_file()), None)
    if found is None:
        raise UserError(f"{folder} has no photo {photo.name}: name the folder that the scene was made from")
    pixels = photo.photo(found).at_most(PHOTO_SIDE).read_uint8()
    written = io.BytesIO()
    Image.fromarray(pixels.numpy()).save(written, "JPEG", quality=_QUALITY)
    return written.getvalue()


def folder_of_run(scene_file: Path | None) -> Path | None:
    """Find the folder of a scene's photos from the run beside its file; None if either is gone."""
    with suppress(UserError):
        if scene_file is not None:
            folder = Path(SceneRecord.read(scene_file.parent / SCENE_FILE).data)
            return folder if folder.is_dir() else None
    return None


def extent(scene: Scene) -> list[float]:
    """Measure what an overview shows, from the camera of `scene.overview`.

    Returns the slopes (x / z and y / z, OpenCV's axes) left, top, right and bottom, beyond each of which lies
    hardly anything of what the photos show of the landmark, and the depth of its middle in world
    units. All of the overview photo belongs to it."""
    camera = scene.overview.full_camera
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    own = [-cx / fx, -cy / fy, (camera.width - cx) / fx, (camera.height - cy) / fy]
    sound, mass = scene.splats.sound(), scene.mass
    places = torch.where(sound[:, None], in_camera_frame(camera, scene.splats.means), 0.0)
    middle = float(places[:, 2][sound].median()) if len(places) else 0.0
    # The sky and distant surroundings lie far behind, and what stands before the landmark hides less of it.
    known, sizes = mass > 0, scene.splats.scales.amax(1)
    kept = (places[:, 2] > 0.5 * middle) & (places[:, 2] < _BEHIND * middle) & known
    if middle <= 0 or not bool(kept.any()):
        return [*own, 1.0]
    kept &= sizes <= max(_LARGE * float(sizes[known].median()), float(sizes[kept].min()))
    places, mass = places[kept], mass[kept]
    ends = list(own)
    for axis in (0, 1):
        slopes, order = (places[:, axis] / places[:, 2]).sort()
        share = mass[order].cumsum(0) / mass.sum()
        low, high = (int((share < level).sum().clamp_max(len(share) - 1)) for level in (_CUT, 1 - _CUT))
        for side, at, sign in ((axis, low, -1), (axis + 2, high, 1)):
            most = max(sign * own[side], min(_WIDER * sign * own[side], _STEEP))
            ends[side] = sign * max(sign * own[side], min(_ROOM * sign * float(slopes[at]), most))
    return [*ends, middle]
