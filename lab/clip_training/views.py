"""Cache of rendered views: one file per landmark, rendered by background processes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray as Array

from lab.clip_training.captions import FAMILIES

SPLITS = {"test": range(0, 1_000), "validation": range(5_000, 6_000), "train": range(10_000, 20_000)}
"""Landmark seeds of each split. Nothing is trained or tuned on the test seeds."""
WIDTH, HEIGHT = 480, 360
COLOR, PART, ELEMENT, MATERIAL = slice(0, 3), 3, 4, 5
"""Channels of a stored view."""


@dataclass(frozen=True)
class LandmarkViews:
    """The views of one landmark: RGB, part, element and material of every pixel, memory-mapped."""

    seed: int
    family: int
    views: UInt8[Array, "n 6 h w"]


class ViewFolder:
    """The landmarks rendered so far in a folder, sorted by seed; `refresh` picks up new ones."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[Path, LandmarkViews] = {}
        self.landmarks: list[LandmarkViews] = []
        self.refresh()

    def refresh(self) -> None:
        for path in self._folder.glob("*_*.npy"):
            if path not in self._known:
                family, seed = path.stem.split("_")
                views = np.load(path, mmap_mode="r").view(np.ndarray)  # plain arrays slice faster
                self._known[path] = LandmarkViews(int(seed), FAMILIES.index(family), views)
        self.landmarks = sorted(self._known.values(), key=lambda landmark: landmark.seed)


def render_landmark(folder: Path, seed: int, views: int) -> Path:
    """Render wild views of a landmark into one file, each with its own light and weather."""
    from lab.landmark.landmark import Landmark
    from lab.landmark.photography import random_view, take_photo

    landmark = Landmark.from_seed(seed)
    rng = np.random.default_rng((seed, 1))
    stack = np.empty((views, 6, HEIGHT, WIDTH), np.uint8)  # planes: crops of them are copied in rows
    for view in stack:
        shot = take_photo(landmark, random_view(landmark, rng, wild=True), WIDTH, HEIGHT)
        view[COLOR] = shot.image.transpose(2, 0, 1)
        view[PART], view[ELEMENT], view[MATERIAL] = shot.parts, shot.elements, shot.materials
    path = folder / f"{landmark.family}_{seed:05d}.npy"
    temporary = path.with_name(f"partial-{seed:05d}-{os.getpid()}.npy")
    np.save(temporary, stack)
    temporary.rename(path)
    return path


@contextmanager
def background_rendering(
    folder: Path, seeds: Iterable[int], views: int, processes: int
) -> Iterator[list[Future[Path]]]:
    """Render missing landmarks in seed order while the block runs."""
    folder.mkdir(parents=True, exist_ok=True)
    present = {int(path.stem.split("_")[1]) for path in folder.glob("*_*.npy")}
    missing = [seed for seed in seeds if seed not in present]
    if not missing or not processes:
        yield []
        return
    # spawn: forking a process that runs torch threads may hang
    pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=os.nice, initargs=(5,))
    try:
        yield [pool.submit(render_landmark, folder, seed, views) for seed in missing]
    finally:
        pool.shutdown(cancel_futures=True)
