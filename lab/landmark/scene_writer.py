"""Generator of demo scenes: a procedural landmark as photos, COLMAP model, masks and ground truth.

The processes that take the photos import this module, but not torch, which takes them longer to load than
several photos; so what needs torch is imported where it is used.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from lab.landmark.demo_scene import CAMERAS, FOLDER, DemoScene
from lab.landmark.labels import CATEGORIES, SMALLEST_POSITIVE, building_mask, category_masks
from lab.landmark.landmark import Landmark
from lab.landmark.novel_cameras import choose_cameras
from lab.landmark.photography import Shot, View, plain_view, random_photo_size, random_view, take_photo
from lab.landmark.raycast import Camera
from lab.landmark.sparse_model import POINTS, Similarity, TakenPhoto, find_tracks, sample_points, write_model
from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded

if TYPE_CHECKING:
    from lang3dxl_ns.scene.colmap import TrackedPhoto

HELD_OUT_EVERY = 8
"""Interval of nerfstudio's split: of the photos sorted by name, 0, 8, 16 … are held out."""
TRUTH_EVERY = 2
"""Interval of the photos that have ground truth. They include the held-out ones."""
OVERSAMPLING = 2
"""Number of rays per pixel along each axis."""
TEST_POINTS = 100
"""Number of surface points per test view, which give the distance of what it shows."""


@dataclass(frozen=True)
class _Order:
    """Job of a worker: one photo or test view to render."""

    number: int
    seed: int
    family: str
    wild: bool
    size: tuple[int, int]
    points: int
    folder: Path
    weathered: bool = False
    test_camera: Camera | None = None
    """Camera of a test view; None for photos, which choose their own."""

    @property
    def name(self) -> str:
        return f"{self.number:04d}"


def write_scene(scene: DemoScene) -> Path:
    """Write images/, masks/, sparse/0/, ground_truth/, test_views/ and scene.json, and return the folder.

    The folder appears once everything is written. Raises UserError for a folder that is not empty, and for
    invalid numbers.
    """
    out = expanded(scene.out).absolute()
    _check(scene, out)
    landmark = Landmark.from_seed(scene.seed, scene.family)
    unfinished = out.with_name(f".{out.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    for name in ("images", "masks", "depth", *(f"ground_truth/{category}" for category in CATEGORIES)):
        (unfinished / name).mkdir(parents=True)

    size = scene.width, scene.height
    points = int(np.clip(POINTS // scene.photos, 40, 400))
    cameras = choose_cameras(landmark, scene.test_views, scene.wild, size)
    places: list[tuple[Path, int, Camera | None]] = [(unfinished, i + 1, None) for i in range(scene.photos)]
    places += [(unfinished / FOLDER, i + 1, camera) for i, camera in enumerate(cameras)]
    orders = [
        _Order(number, scene.seed, landmark.family, scene.wild, size, points, folder, scene.weathered, camera)
        for folder, number, camera in places
    ]
    taken = list(_taken(orders, scene.workers))
    photos, views = taken[: scene.photos], taken[scene.photos :]
    rng = np.random.default_rng([scene.seed, 3])
    similarity = Similarity.random(rng)
    tracks = find_tracks(photos, [unfinished / "depth" / f"{photo.number:04d}.npy" for photo in photos], rng)
    write_model(unfinished / "sparse" / "0", photos, tracks, similarity, one_camera=not scene.wild)
    shutil.rmtree(unfinished / "depth")
    if views:
        geometries = [_tracked(view, similarity) for view in views]
        write_novel_cameras(unfinished, geometries, same_light=not scene.wild)
    _write_description(unfinished, landmark, scene, similarity)
    if out.exists():
        out.rmdir()  # `_check` found it empty
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished.rename(out)
    return out


def photo_view(
    landmark: Landmark, seed: int, number: int, wild: bool, size: tuple[int, int]
) -> tuple[View, int, int]:
    """Return the view of photo `number` of a scene, and its width and height in pixels."""
    rng = np.random.default_rng([seed, 2, number])
    width, height = random_photo_size(rng, *size) if wild else size
    return random_view(landmark, rng, wild), width, height


def _check(scene: DemoScene, out: Path) -> None:
    if not 4 <= scene.photos <= 9999:
        raise UserError(f"--photos is {scene.photos}: a scene has 4 to 9999 (numbers have four digits)")
    if not 0 <= scene.test_views <= 9999:
        raise UserError(f"--test-views is {scene.test_views}: give 0 to 9999")
    if scene.seed < 0:
        raise UserError(f"--seed is {scene.seed}: give 0 or more")
    if min(scene.width, scene.height) < 64:
        raise UserError(
            f"--width and --height are {scene.width} and {scene.height}: both must be 64 pixels or more"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} exists and isn't an empty folder: give --out another name, or remove it")


def _taken(orders: list[_Order], workers: int | None) -> Iterator[TakenPhoto]:
    """Yield photos in order, taken by a process pool, or by this process if it is the only worker, with a
    progress bar."""
    workers = min(workers or os.cpu_count() or 1, len(orders))
    # Processes are spawned, because forked ones would inherit this one's threads and loaded libraries.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context) if workers > 1 else nullcontext() as pool:
        take = map if pool is None else pool.map
        yield from tracked(take(_take, orders), "taking photos", len(orders))


@lru_cache(maxsize=1)
def _landmark(seed: int, family: str, weathered: bool) -> Landmark:
    return Landmark.from_seed(seed, family, weathered)


def _take(order: _Order) -> TakenPhoto:
    """Take one photo and write its files, in a worker."""
    landmark = _landmark(order.seed, order.family, order.weathered)
    if order.test_camera is not None:
        return _take_test_view(landmark, order.test_camera, order)
    view, width, height = photo_view(landmark, order.seed, order.number, order.wild, order.size)
    shot = take_photo(landmark, view, width, height, OVERSAMPLING)
    photo = Image.fromarray(shot.image)
    save_photo = partial(photo.save, quality=93, subsampling=0)
    save_photo(order.folder / "images" / f"{order.name}.jpg")
    Image.fromarray(building_mask(shot.parts)).save(order.folder / "masks" / f"{order.name}.png")
    np.save(order.folder / "depth" / f"{order.name}.npy", shot.depth.astype(np.float16))
    if (order.number - 1) % TRUTH_EVERY == 0:
        _write_truth(shot, save_photo, order)
    points, colors = sample_points(
        shot, view.camera, order.points, np.random.default_rng([order.seed, 4, order.number])
    )
    return TakenPhoto(order.number, width, height, view.camera, points, colors)


def _take_test_view(landmark: Landmark, camera: Camera, order: _Order) -> TakenPhoto:
    """Take a test view and write its picture, mask and labels (white on black), in a worker."""
    shot, name = take_photo(landmark, plain_view(camera), *order.size, OVERSAMPLING), f"{order.name}.png"
    masks = {f"ground_truth/{c}": mask for c, mask in category_masks(shot.parts, shot.elements).items()}
    masks = {place: mask for place, mask in masks.items() if mask.mean() >= SMALLEST_POSITIVE}
    for place, mask in {"masks": building_mask(shot.parts), **masks}.items():
        (order.folder / place).mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(order.folder / place / name)
    (order.folder / "images").mkdir(exist_ok=True)
    picture = Image.fromarray(shot.image)
    picture.save(order.folder / "images" / f"{order.name}.jpg", quality=93, subsampling=0)
    rng = np.random.default_rng([order.seed, 6, order.number])
    return TakenPhoto(order.number, *order.size, camera, *sample_points(shot, camera, TEST_POINTS, rng))


def _tracked(view: TakenPhoto, similarity: Similarity) -> TrackedPhoto:
    """Convert a test view's camera to the COLMAP model's world."""
    from lang3dxl_ns.scene.camera import Lens
    from lang3dxl_ns.scene.colmap import TrackedPhoto

    focal, points = view.camera.focal * max(view.width, view.height), similarity.apply(view.points)
    return TrackedPhoto(
        name=f"{view.number:04d}.jpg",
        lens=Lens(view.width, view.height, focal, focal, view.width / 2, view.height / 2),
        camera_from_world=similarity.camera_from_world(view.camera),
        points=points,
        pixels=np.zeros((len(points), 2)),
    )


def write_novel_cameras(folder: Path, cameras: Sequence[TrackedPhoto], same_light: bool) -> None:
    """Write test_views/cameras.json into a scene's `folder`; views are named after their files."""
    views = [
        {
            "name": g.name,
            "width": g.width,
            "height": g.height,
            "intrinsics": [g.lens.fx, g.lens.fy, g.lens.cx, g.lens.cy],
            "camera_from_world": g.camera_from_world.tolist(),
            "points": g.points.round(6).tolist(),
        }
        for g in cameras
    ]
    content = {"same_light": same_light, "views": views}
    (folder / FOLDER / CAMERAS).write_text(json.dumps(content) + "\n")


def _write_truth(shot: Shot, save_photo, order: _Order) -> None:
    """Write HolyScenes' layout: for each category in the photo, object black on white, and the photo's
    copy."""
    for category, mask in category_masks(shot.parts, shot.elements).items():
        if mask.mean() < SMALLEST_POSITIVE:
            continue
        folder = order.folder / "ground_truth" / category
        truth = Image.fromarray(np.where(mask, np.uint8(0), np.uint8(255)))
        truth.save(folder / f"{order.name}-gt.jpg", quality=100)
        save_photo(folder / f"{order.name}-img.jpg")


def _write_description(folder: Path, landmark: Landmark, scene: DemoScene, similarity: Similarity) -> None:
    """Write scene.json, a description of the scene for people and tests."""
    truth = {
        c: sorted(path.name[:4] for path in (folder / "ground_truth" / c).glob("*-gt.jpg"))
        for c in CATEGORIES
    }
    for category, numbers in truth.items():
        if not numbers:
            (folder / "ground_truth" / category).rmdir()
    description = {
        "seed": scene.seed,
        "family": landmark.family,
        "wild": scene.wild,
        "photos": scene.photos,
        "categories": [category for category, numbers in truth.items() if numbers],
        "ground_truth_photos": {category: len(numbers) for category, numbers in truth.items() if numbers},
        "test_views": scene.test_views,
        "held_out": [f"{i + 1:04d}.jpg" for i in range(0, scene.photos, HELD_OUT_EVERY)],
        "colmap_from_meters": {
            "scale": similarity.scale,
            "rotation": similarity.rotation.tolist(),
            "translation": similarity.translation.tolist(),
        },
    }
    (folder / "scene.json").write_text(json.dumps(description, indent=1) + "\n")
