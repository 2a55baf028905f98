"""Views of a splat made without photos: around it and in it, outside of matter, chosen to show all of it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from heapq import heapify, heappop, heappush
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from lang3dxl_ns.attachment import direction_of
from lang3dxl_ns.attachment.upright import BACKGROUND, CERTAIN, find_up, name_of_axis
from lang3dxl_ns.common.console import say, tracked
from lang3dxl_ns.common.errors import DAMAGE, UserError
from lang3dxl_ns.common.files import make_folder, own_folder, read_json, replace_file
from lang3dxl_ns.query.match import as_bytes, save_picture
from lang3dxl_ns.query.visibility import fingerprint
from lang3dxl_ns.rendering import Rendering, Splats, composite, render
from lang3dxl_ns.rendering.gathering import filled_pixels
from lang3dxl_ns.scene.camera import Camera, Lens, in_camera_frame, level, looking, resized
from lang3dxl_ns.scene.capture import Capture
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto
from lang3dxl_ns.scene.photo import Photo

LENS = Lens(480, 360, 384.0, 384.0, 240.0, 180.0)
"""Lens of the views, 64 degrees wide like a phone's."""
_RULE = 4
"""Version of the rule. It is increased when views are chosen or rendered in another way."""
_OPAQUE = 0.3
_NEAR = 0.03
"""Distance that a camera keeps from matter, in radii of the scene."""
_CLOSE = 0.1
"""Depth in radii below which a pixel shows something too close. `_MOST_CLOSE` limits their share."""
_MOST_CLOSE = 0.1
_COVERED = 0.35
"""Smallest share of a view that the splat must cover."""
_BLURRED = 2.0
"""Median size of a view's Gaussians, relative to the median view's, above which it is taken too close."""
_PROBES, _ROOFED = 64, 0.7
"""Number of places tried, and the share of them with matter above from which a scene is indoors."""
_RING = (1.6, 5.0)
"""Distances of the views around a scene, in radii. From closer by, its parts fill a view, and their crops
lack the surroundings by which CLIP distinguishes them."""
_CANDIDATES = 5
"""Number of candidates for every requested view."""
_SIDE = 96
"""Longer side of the views by which candidates are judged, pixels."""
_SAMPLE = 30_000
"""Number of Gaussians by which candidates are judged."""
_ENOUGH = 4.0
"""Pixels of a small view that are enough to show a Gaussian well. Further ones count less."""
_POINTS = 400
"""Number of points per view, from its depth, which give the sizes of crops."""


@dataclass(frozen=True)
class Extent:
    """Position and size of a splat's matter."""

    center: Float[Tensor, "3"]
    radius: float
    """Distance from the center that holds three quarters of the matter."""
    up: Float[Tensor, "3"]
    ground: float
    """Height of the ground above the center, along `up`."""

    @classmethod
    def of(cls, splats: Splats, up: str) -> Extent:
        """Measure the extent. Raises UserError if there is no matter."""
        solid = solids(splats)
        center = solid.means.median(0).values
        places = solid.means - center
        distance = places.norm(dim=1)
        radius = float(distance.quantile(0.75))
        direction = _found_up(solid, center, radius) if up == "auto" else places.new_tensor(direction_of(up))
        near = places[distance < 1.5 * radius]
        return cls(center, radius, direction, float((near @ direction).quantile(0.05)))


def solids(splats: Splats) -> Splats:
    """Select the opaque Gaussians, at most 200,000 of them. Raises UserError if there are hardly any."""
    rows = (splats.opacities > _OPAQUE).nonzero()[:, 0]
    if len(rows) < 10:
        raise UserError("hardly any Gaussian of this splat is opaque: nothing can be seen in it")
    return splats.select(rows[:: -(-len(rows) // 200_000)])


def _found_up(solid: Splats, center: Float[Tensor, "3"], radius: float) -> Float[Tensor, "3"]:
    """Find the up direction, and say what was found, how certainly, and how to change it."""
    found = find_up(solid, center, radius)
    ways = found.direction, found.second
    numbers = [f"{x:.2f},{y:.2f},{z:.2f}" for x, y, z in map(Tensor.tolist, ways)]
    name, other = (f"{name_of_axis(way)} ({text})" for way, text in zip(ways, numbers, strict=True))
    if found.margin >= CERTAIN:
        say(f"up is about {name}, by a margin of {found.margin:.1f}; --up sets another direction")
    else:
        say(
            f"the up direction is uncertain: {name} leads {other} by only {found.margin:.1f}. If the views "
            f"aren't upright, set --up={numbers[1]}"
        )
    return found.direction


def rendered_views(splats: Splats, count: int, up: str, folder: Path) -> Capture:
    """Render this many pictures of a splat as a photo collection, in the splat's frame. They are kept in
    `folder`, and rendered again only for another splat or other settings. Raises UserError if no view shows
    the splat well."""
    how = [_RULE, count, up, splats.antialiased]
    stamp = fingerprint(vars(splats.gaussians) | {"harmonics": splats.harmonics}, how)
    kept = _kept(own_folder(folder), stamp)
    cameras = kept or choose_views(splats, Extent.of(splats, up), count)
    background = splats.means.new_tensor(BACKGROUND)
    names = [f"{i:04d}.png" for i in range(len(cameras))]
    make_folder(folder)
    if kept is None:  # pictures of another splat, or, if this is interrupted, of two
        (folder / "views.json").unlink(missing_ok=True)
    seen, chosen = {}, np.random.default_rng(0)
    for name, camera in tracked(zip(names, cameras, strict=True), "rendering views", len(cameras)):
        view = render(splats, camera, background=background)
        path = folder / "images" / name
        if kept is None or not path.is_file():
            save_picture(as_bytes(view.rgb), path)
        seen[name] = _tracked(name, view, chosen)
    content = {"of": stamp, "views": [camera.view_matrix.tolist() for camera in cameras]}
    replace_file(folder / "views.json", json.dumps(content))
    photos = [Photo(name, folder / "images" / name, None, LENS) for name in names]
    points = np.concatenate([photo.points for photo in seen.values()])
    reconstruction = Reconstruction(seen, points, np.zeros(points.shape, np.uint8))
    return Capture(folder, photos, reconstruction, {})


def _kept(folder: Path, stamp: str) -> list[Camera] | None:
    """Read the cameras of an earlier call for the same splat; None if there was none."""
    try:
        content = read_json(folder / "views.json")
        views = torch.tensor(content["views"]).float().reshape(-1, 4, 4)
        return [LENS.camera(view) for view in views] if content["of"] == stamp else None
    except DAMAGE:
        return None


def _tracked(name: str, view: Rendering, chosen: np.random.Generator) -> TrackedPhoto:
    """Build a tracked photo from a view, with points of the surfaces that it shows."""
    rows, columns = (view.alpha > 0.8).cpu().numpy().nonzero()
    some = chosen.permutation(len(rows))[:_POINTS]
    rows, columns = rows[some], columns[some]
    depth = view.depth.cpu().double().numpy()[rows, columns]
    pixels = np.column_stack([columns + 0.5, rows + 0.5])
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(LENS.matrix.numpy()).T
    pose = view.camera.view_matrix.double().numpy()
    points = (rays * depth[:, None] - pose[:3, 3]) @ pose[:3, :3]
    return TrackedPhoto(name, LENS, pose[:3], points, pixels)


def choose_views(splats: Splats, extent: Extent, count: int) -> list[Camera]:
    """Choose views that together show the most Gaussians at the size at which they were made.

    Candidates are placed around the scene and in it, at several heights and distances. Those that are too
    close to matter, show little, or show it blurred are dropped. From the rest, the one that adds most is
    chosen, again and again. Raises UserError if no candidate is left.
    """
    sample = torch.linspace(0, len(splats) - 1, min(_SAMPLE, len(splats)), dtype=torch.float64).long()
    free = _FreeSpace(solids(splats), extent)
    views = list[tuple[Camera, Float[Tensor, " sample"], float]]()
    placed = candidates(extent, free, _CANDIDATES * count)
    for camera in tracked(placed, "choosing views", _CANDIDATES * count):
        if (judged := _judged(splats, camera, extent)) is not None:
            views.append((camera, judged[0][sample.to(judged[0].device)].cpu(), judged[1]))
    if not views:
        raise UserError("no view shows this splat well: give its photos (--data)")
    blurred = _BLURRED * float(torch.tensor([size for *_, size in views]).median())
    cameras, shown, _ = zip(*(view for view in views if view[-1] <= blurred), strict=True)
    found = _cover(torch.stack(shown), min(count, len(cameras)))
    say(f"{len(found)} views chosen of {len(cameras)} that show the splat well")
    return [cameras[i] for i in found]


def _cover(shown: Float[Tensor, "views n"], count: int) -> list[int]:
    """Choose views greedily. A Gaussian's first pixels count most."""
    total, chosen = torch.zeros_like(shown[0]), list[int]()

    def gain(view: int) -> float:
        return float((shown[view] / (_ENOUGH + total)).log1p().sum())

    waiting = [(-gain(view), view) for view in range(len(shown))]
    heapify(waiting)
    while len(chosen) < count:
        view = heappop(waiting)[1]
        # Gains only shrink, so a view that still gains as much as others gained before is the best.
        if waiting and (now := gain(view)) < -waiting[0][0]:
            heappush(waiting, (-now, view))
            continue
        chosen.append(view)
        total = total + shown[view]
    return sorted(chosen)


def _judged(splats: Splats, camera: Camera, extent: Extent) -> tuple[Float[Tensor, " n"], float] | None:
    """Compute how many pixels each Gaussian fills in a small view, and the median size of the visible ones,
    in pixels of the large view. Returns None for a view that is not worth taking."""
    small = resized(camera, _SIDE)
    view = render(splats, small)
    solid = view.alpha > 0.5
    if float(solid.float().mean()) < _COVERED:
        return None
    if float((view.depth[solid] < _CLOSE * extent.radius).float().mean()) > _MOST_CLOSE:
        return None
    pixels = filled_pixels(partial(composite, splats, small), torch.ones_like(view.alpha), len(splats))
    seen = pixels > 0.1
    if not seen.any():
        return None
    depth = in_camera_frame(camera, splats.means[seen])[:, 2].clamp_min(1e-6)
    return pixels, float((splats.scales[seen].amax(1) * LENS.fx / depth).median())


class _FreeSpace:
    """Space without matter, for cameras. Its places are not close to matter. In scenes under the sky they are
    not below matter either, because a building of which only the outside was seen is hollow."""

    def __init__(self, solid: Splats, extent: Extent) -> None:
        near = (solid.means - extent.center).norm(dim=1) < 3 * extent.radius
        solid = solid.select(near)
        self._extent, self._margin = extent, _NEAR * extent.radius
        self._tree = KDTree(solid.means.cpu().numpy())
        self._reach = solid.scales.amax(1).clamp_max(0.2 * extent.radius).cpu().numpy()
        self._plan = torch.stack([level(extent.up), level(extent.up, 0.25)], dim=1)
        self._from_above = KDTree((solid.means @ self._plan).cpu().numpy())
        self._heights = (solid.means @ extent.up).cpu().numpy()
        self._width = 2 * (self._margin + float(np.median(self._reach)))
        draw = torch.Generator().manual_seed(1)
        places = [_inside(extent, draw)[0] for _ in range(_PROBES)]
        self.indoors = sum(map(self.roofed, places)) > _ROOFED * _PROBES

    def __contains__(self, place: Float[Tensor, "3"]) -> bool:
        distance, rows = self._tree.query(place.cpu().numpy(), k=8)
        far = distance - 2 * self._reach[np.minimum(rows, len(self._reach) - 1)] > self._margin
        return bool(far.all()) and (self.indoors or not self.roofed(place))

    def roofed(self, place: Float[Tensor, "3"]) -> bool:
        """Return whether there is matter above a place."""
        rows = self._from_above.query_ball_point((place @ self._plan).cpu().numpy(), self._width)
        return bool((self._heights[rows] > float(place @ self._extent.up) + self._margin).any())


def candidates(extent: Extent, free: _FreeSpace, count: int) -> Iterator[Camera]:
    """Yield cameras in free space: two thirds around the scene, looking in, a third in it, looking around."""
    draw = torch.Generator().manual_seed(0)
    found = tries = 0
    while found < count and tries < 20 * count:
        tries += 1
        place, target = _inside(extent, draw) if tries % 3 == 0 else _around(extent, draw)
        if place in free:
            found += 1
            yield LENS.camera(looking(place.cpu(), target.cpu(), extent.up.cpu()))


def _around(extent: Extent, draw: torch.Generator) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Draw a place within `_RING`, up to 40 degrees above the ground, and a target in the inner half."""
    angle, height, distance, *aim = torch.rand(6, generator=draw).tolist()
    elevation = math.radians(40) * height**2
    away = extent.radius * _RING[0] * (_RING[1] / _RING[0]) ** distance
    direction = level(extent.up, angle)
    floor = extent.center + (extent.ground + 0.08 * extent.radius) * extent.up
    place = floor + away * (math.cos(elevation) * direction + math.sin(elevation) * extent.up)
    offset = torch.tensor([2 * value - 1 for value in aim]).to(place)
    return place, extent.center + 0.5 * extent.radius * offset


def _inside(extent: Extent, draw: torch.Generator) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Draw a place within a radius, a person's or a story's height above the ground, and a target around."""
    x, y, height, angle, tilt = torch.rand(5, generator=draw).tolist()
    side, front = level(extent.up), level(extent.up, 0.25)
    place = extent.center + extent.radius * ((2 * x - 1) * side + (2 * y - 1) * front)
    place = place + (extent.ground + extent.radius * (0.08 + 0.4 * height**2)) * extent.up
    return place, place + level(extent.up, angle) + (0.5 * tilt - 0.15) * extent.up
