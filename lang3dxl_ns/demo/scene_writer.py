"""A procedural landmark as a user's folder: photos, a COLMAP model, masks and ground truth."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lang3dxl_ns.demo.contact_sheet import contact_sheet
from lang3dxl_ns.demo.labels import CATEGORIES, SMALLEST_POSITIVE, building_mask, category_masks
from lang3dxl_ns.demo.landmark import Landmark
from lang3dxl_ns.demo.photography import Shot, View, random_photo_size, random_view, take_photo
from lang3dxl_ns.demo.sparse_model import (
    POINTS,
    Similarity,
    TakenPhoto,
    find_tracks,
    sample_points,
    write_model,
)
from lang3dxl_ns.errors import UserError

HELD_OUT_EVERY = 8
"""nerfstudio's interval split: of the photos sorted by name, 0, 8, 16 … are not trained on."""
TRUTH_EVERY = 2
"""Every second photo has ground truth, the held-out ones among them."""
OVERSAMPLING = 2
"""Rays per pixel and axis."""


@dataclass
class DemoScene:
    """Make a scene to try everything on: a procedural landmark, photographed."""

    out: Path
    """Folder to write; must not hold anything yet."""
    seed: int = 0
    """Same seed, same bytes."""
    family: Literal["cathedral", "mosque", "hall", "auto"] = "auto"
    """Kind of building; auto: the seed chooses."""
    photos: int = 48
    """How many photos, 4 to 9999."""
    wild: bool = True
    """As from the Internet: other sizes, lenses, weather, exposures and passers-by in every photo. --no-wild:
    one camera, one sun, nobody there."""
    width: int = 480
    """Pixels of a landscape photo; wild photos vary below it."""
    height: int = 360
    """Pixels of a landscape photo."""
    contact_sheet: bool = False
    """Also write contact_sheet.jpg: six photos with their ground truth."""
    workers: int | None = None
    """Processes; one per CPU core without it."""

    def main(self) -> None:
        """Write the scene and say where it is."""
        from rich import get_console

        folder = write_scene(self)
        get_console().print(
            f"{self.photos} photos, COLMAP model, masks and ground truth in {folder}", soft_wrap=True
        )


@dataclass(frozen=True)
class _Order:
    """One photo for a worker to take."""

    number: int
    seed: int
    family: str
    wild: bool
    size: tuple[int, int]
    points: int
    folder: Path

    @property
    def name(self) -> str:
        return f"{self.number:04d}"


def write_scene(scene: DemoScene) -> Path:
    """Write images/, masks/, sparse/0/, ground_truth/ and scene.json; returns the folder.

    The folder appears when all of it is written. Raises UserError for a folder that holds something, and for
    impossible numbers.
    """
    out = Path(scene.out).expanduser().absolute()
    _check(scene, out)
    landmark = Landmark.from_seed(scene.seed, scene.family)
    unfinished = out.with_name(f".{out.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    for name in ("images", "masks", "depth", *(f"ground_truth/{category}" for category in CATEGORIES)):
        (unfinished / name).mkdir(parents=True)

    orders = [
        _Order(
            number=i + 1,
            seed=scene.seed,
            family=landmark.family,
            wild=scene.wild,
            size=(scene.width, scene.height),
            points=int(np.clip(POINTS // scene.photos, 40, 400)),
            folder=unfinished,
        )
        for i in range(scene.photos)
    ]
    photos = list(_taken(orders, scene.workers))
    rng = np.random.default_rng([scene.seed, 3])
    similarity = Similarity.random(rng)
    tracks = find_tracks(photos, [unfinished / "depth" / f"{order.name}.npy" for order in orders], rng)
    write_model(unfinished / "sparse" / "0", photos, tracks, similarity, one_camera=not scene.wild)
    shutil.rmtree(unfinished / "depth")
    _write_description(unfinished, landmark, scene, similarity)
    if scene.contact_sheet:
        contact_sheet(unfinished).save(unfinished / "contact_sheet.jpg", quality=88)
    if out.exists():
        out.rmdir()  # it is empty: checked above
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished.rename(out)
    return out


def photo_view(
    landmark: Landmark, seed: int, number: int, wild: bool, size: tuple[int, int]
) -> tuple[View, int, int]:
    """The view that photo `number` of a scene has, and its width and height in pixels."""
    rng = np.random.default_rng([seed, 2, number])
    width, height = random_photo_size(rng, *size) if wild else size
    return random_view(landmark, rng, wild), width, height


def _check(scene: DemoScene, out: Path) -> None:
    if not 4 <= scene.photos <= 9999:
        raise UserError(f"--photos is {scene.photos}: a scene has 4 to 9999 (numbers have four digits)")
    if scene.seed < 0:
        raise UserError(f"--seed is {scene.seed}: give 0 or more")
    if min(scene.width, scene.height) < 64:
        raise UserError(
            f"--width and --height are {scene.width} and {scene.height}: both must be 64 pixels or more"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} exists and isn't an empty folder: give --out another name, or remove it")


def _taken(orders: list[_Order], workers: int | None) -> Iterator[TakenPhoto]:
    """Photos in their order, taken by a pool of processes, with a progress bar."""
    workers = min(workers or os.cpu_count() or 1, len(orders))
    # Fresh processes: forked ones would inherit this one's threads and loaded libraries.
    context = multiprocessing.get_context("spawn")
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as bar, ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from bar.track(pool.map(_take, orders), total=len(orders), description="taking photos")


@lru_cache(maxsize=1)
def _landmark(seed: int, family: str) -> Landmark:
    return Landmark.from_seed(seed, family)


def _take(order: _Order) -> TakenPhoto:
    """In a worker: take one photo and write its files."""
    landmark = _landmark(order.seed, order.family)
    view, width, height = photo_view(landmark, order.seed, order.number, order.wild, order.size)
    shot = take_photo(landmark, view, width, height, OVERSAMPLING)
    photo = Image.fromarray(shot.image)
    save_photo = partial(photo.save, quality=93, subsampling=0)
    save_photo(order.folder / "images" / f"{order.name}.jpg")
    Image.fromarray(building_mask(shot.parts)).save(order.folder / "masks" / f"{order.name}.png")
    np.save(order.folder / "depth" / f"{order.name}.npy", shot.depth.astype(np.float16))
    if (order.number - 1) % TRUTH_EVERY == 0:
        _write_truth(shot, save_photo, order)
    points, colours = sample_points(
        shot, view.camera, order.points, np.random.default_rng([order.seed, 4, order.number])
    )
    return TakenPhoto(order.number, width, height, view.camera, points, colours)


def _write_truth(shot: Shot, save_photo, order: _Order) -> None:
    """HolyScenes' layout: object black on white, and a copy of the photo, for each category in it."""
    for category, mask in category_masks(shot.parts, shot.elements).items():
        if mask.mean() < SMALLEST_POSITIVE:
            continue
        folder = order.folder / "ground_truth" / category
        truth = Image.fromarray(np.where(mask, np.uint8(0), np.uint8(255)))
        truth.save(folder / f"{order.name}-gt.jpg", quality=100)
        save_photo(folder / f"{order.name}-img.jpg")


def _write_description(folder: Path, landmark: Landmark, scene: DemoScene, similarity: Similarity) -> None:
    """scene.json: what the scene is, for people and for tests."""
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
        "held_out": [f"{i + 1:04d}.jpg" for i in range(0, scene.photos, HELD_OUT_EVERY)],
        "colmap_from_metres": {
            "scale": similarity.scale,
            "rotation": similarity.rotation.tolist(),
            "translation": similarity.translation.tolist(),
        },
    }
    (folder / "scene.json").write_text(json.dumps(description, indent=1) + "\n")
