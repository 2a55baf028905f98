"""Labeled street photos as training views: pixel classes, sky, and a daylight version."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray as Array
from PIL import Image
from scipy import ndimage

from lab.clip_training.captions import CLASS, UNLABELED
from lab.clip_training.views import COLOR, PART, LandmarkViews
from lang3dxl_ns.common.errors import UserError

# their label: our class
_CLASS_OF = {
    "window": "window",
    "facade": "facade",
    "vegetation": "tree",
    "street": "road",
    "car": "car",
    "balcony-fence": "balcony",
    "fence": "fence",
    "shop": "shop",
    "traffic-infrastructure": "sign",
}
_SIDE = 512  # pixels of the longer side as stored
_SMALLEST_SKY = 5e-3  # share of a photo
_SMALLEST_FACADE = 0.05  # share of a photo: with less, the building was not labeled
_LIT = 0.4  # mean brightness above which a photo counts as taken by day


def store_photos(folder: Path, cache: Path, split: str) -> list[LandmarkViews]:
    """Every photo whose name begins with the split (or "train": all but "valid"), as two views: as taken, and
    by daylight. Written to the cache once, then memory-mapped.

    Raises UserError if the folder does not hold labeled photos.
    """
    try:
        labels: dict[str, int] = json.loads((folder / "classes.json").read_text())["classes"]
    except (OSError, KeyError, ValueError) as error:
        raise UserError(f"{folder} is not a folder of labeled photos: classes.json can't be read") from error
    table = np.full(256, UNLABELED, np.uint8)
    for name, class_ in _CLASS_OF.items():
        table[labels[name]] = CLASS[class_]
    cache.mkdir(parents=True, exist_ok=True)
    views = []
    for index, path in enumerate(sorted((folder / "images").iterdir())):
        if path.name.startswith("valid") == (split == "train"):
            continue
        stored = cache / f"{path.stem}.npy"
        if not stored.exists():
            temporary = cache / f"partial-{path.stem}.npy"
            np.save(temporary, _views(path, folder / "labels" / f"{path.stem}.png", table, index))
            temporary.rename(stored)
        view = np.load(stored, mmap_mode="r").view(np.ndarray)
        if (view[0, PART] == CLASS["facade"]).mean() > _SMALLEST_FACADE:
            views.append(LandmarkViews(index, -1, view))
    return views


def _views(path: Path, label_path: Path, table: UInt8[Array, " 256"], seed: int) -> UInt8[Array, "2 6 h w"]:
    photo = Image.open(path).convert("RGB")
    photo.thumbnail((_SIDE, _SIDE), Image.Resampling.LANCZOS)
    classes = table[np.asarray(Image.open(label_path).resize(photo.size, Image.Resampling.NEAREST))]
    sky = sky_mask(classes)
    classes = np.where(sky, CLASS["sky"], classes)
    image = np.asarray(photo)
    stack = np.zeros((2, 6, *classes.shape), np.uint8)
    stack[:, PART] = classes
    stack[0, COLOR] = image.transpose(2, 0, 1)
    stack[1, COLOR] = by_day(image, sky, np.random.default_rng(seed)).transpose(2, 0, 1)
    return stack


def sky_mask(classes: UInt8[Array, "h w"]) -> Bool[Array, "h w"]:
    """The unlabeled pixels from the upper edge down to the first label of each column: the sky, which the
    annotators of buildings left out."""
    unlabeled = classes == UNLABELED
    first = np.where(unlabeled.all(0), 0, (~unlabeled).argmax(0))
    above = unlabeled & (np.arange(len(classes))[:, None] < first)
    regions, _ = ndimage.label(above)
    large = np.bincount(regions.ravel()) > _SMALLEST_SKY * classes.size
    large[0] = False
    return large[regions]


def by_day(
    image: UInt8[Array, "h w 3"], sky: Bool[Array, "h w"], rng: np.random.Generator
) -> UInt8[Array, "h w 3"]:
    """The photo as if taken by day: a dark one is brightened and its color cast removed, and the sky is
    replaced by a bright one, blue, white or gray, with clouds."""
    x = image.astype(np.float32) / 255
    ground = x[~sky]
    brightness = ground.mean()
    cast = ground.mean(0) / max(brightness, 0.02)
    x = x / cast.clip(0.2) ** rng.uniform(0.4, 1.0)
    if brightness < _LIT:
        x = np.clip(x, 0, 1) ** (np.log(rng.uniform(0.38, 0.55)) / np.log(max(brightness, 0.02)))
    soft = ndimage.gaussian_filter(sky.astype(np.float32), 0.7)[..., None]
    x = x + (_day_sky(sky.shape, rng) - x) * soft
    return (x.clip(0, 1) * 255).astype(np.uint8)


def _day_sky(shape: tuple[int, ...], rng: np.random.Generator) -> Float[Array, "h w 3"]:
    """A gradient from the zenith's color to a paler horizon, under clouds of smooth noise."""
    zenith = np.array([[0.35, 0.55, 0.85], [0.75, 0.8, 0.85], [0.97, 0.97, 0.97], [0.6, 0.63, 0.68]])
    color = zenith[rng.integers(len(zenith))] + rng.normal(0, 0.05, 3)
    pale = color + (1 - color) * rng.uniform(0.2, 0.8)
    height: Int[Array, "h 1 1"] = np.linspace(0, 1, shape[0])[:, None, None]
    clouds = sum(
        ndimage.zoom(rng.normal(size=(n, n)), (shape[0] / n, shape[1] / n), order=1) / n for n in (4, 9, 19)
    )
    cover = np.clip(rng.normal(0, 1.5) * clouds[..., None] + rng.uniform(-0.5, 0.5), 0, 1)
    sky = color + (pale - color) * height
    return (sky + (rng.uniform(0.75, 1.0) - sky) * cover).astype(np.float32)
