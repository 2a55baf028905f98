"""Scores of single things against boxes that people drew in photos: COCO instances, or LERF-OVS labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.ndimage import find_objects
from scipy.optimize import linear_sum_assignment

from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.files.coco import is_ours
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.scene.names import resolve
from lang3dxl_ns.scene.record import ScenePhoto
from lang3dxl_ns.things.write import coco

MOST_SIDE = 2048
"""Pixels of the longer side, at most, at which boxes are undistorted."""


def score_things(scene: Scene, path: Path) -> list[tuple[str, int, int, int, float | None]]:
    """Compare the things of each category of a COCO file, or of a folder of LERF-OVS labels, with its boxes,
    in the photos that it names. Return for each word the number of boxes there, found (intersection over
    union of at least a half) and false, and F1 (None without any box). Raises UserError for other files."""
    sizes = {photo.name: photo.file_size for photo in scene.photos}
    if path.is_dir():
        labels = GroundTruth(path, "lerf_ovs")
        labels.check(sizes)
        words, names = labels.categories, {name for name in sizes if labels.key(name)}
        marked = ((n, word, one) for n in names for word, one in labels.truths(n, sizes[n][::-1]).items())
        true = {(n, word): (np.array(one.boxes) / (2 * sizes[n])).tolist() for n, word, one in marked}
    elif not path.exists():
        raise UserError(f"there is no {path}: name a COCO file, or a folder of LERF-OVS labels")
    else:
        with readable(f"{path} holds no COCO instances", "export the boxes from the labeling tool as COCO"):
            content = read_json(path)
            words = list(dict.fromkeys(str(category["name"]) for category in content["categories"]))
            files = list(dict.fromkeys(str(image["file_name"]) for image in content["images"]))
            found, _ = resolve(files, sizes.__contains__, lambda: sizes, "photos")
            for image in content["images"]:
                image["file_name"] = found.get(str(image["file_name"]))
            true, names = _boxes(content), set(found.values())
        if names and (absent := [file for file in files if file not in found]):
            say(f"{len(absent)} photos of {path} fit none of this scene, or several: {some(absent)}")
    if not names or not words:
        raise UserError(f"{path} names no photo of this scene: file_name must be {scene.photos[0].name}, …")
    if not path.is_dir():
        drawn = [] if is_ours(content) else content["images"]  # ours are of undistorted photos
        sizes = {image["file_name"]: (image["width"], image["height"]) for image in drawn}
    bent = {one.name: one for one in scene.photos if one.lens.distorts or one.quarter_turns}
    for (name, word), boxes in true.items():
        if name in bent and name in sizes:
            true[name, word] = _undistorted(bent[name], sizes[name], boxes)
    given, scores = _boxes(coco(scene, scene.things([Prompt(word) for word in words]))), []
    for word in words:
        sides = [[np.array(of.get((n, word), [])).reshape(-1, 4) for of in (true, given)] for n in names]
        there, listed = (sum(len(side[i]) for side in sides) for i in (0, 1))
        right = sum(_matches(*side) for side in sides)
        f1 = round(2 * right / (there + listed), 3) if there + listed else None
        scores.append((word, there, right, listed - right, f1))
    return scores


def _boxes(content: dict[str, Any]) -> dict[tuple[str, str], list[list[float]]]:
    """List corners, as shares of the photo's sides, by photo and word."""
    images = {one["id"]: (one["file_name"], one["width"], one["height"]) for one in content["images"]}
    words = {c["id"]: str(c["name"]) for c in content["categories"]}
    found: dict[tuple[str, str], list[list[float]]] = {}
    for label in content["annotations"]:
        (name, wide, tall), (x, y, width, height) = images[label["image_id"]], map(float, label["bbox"])
        corners = [x / wide, y / tall, (x + width) / wide, (y + height) / tall]
        found.setdefault((name, words[label["category_id"]]), []).append(corners)
    return found


def _undistorted(photo: ScenePhoto, size: tuple[int, int], boxes: list[list[float]]) -> list[list[float]]:
    """Return what bounds boxes in the undistorted photo that were drawn on its file, of this size. What lies
    outside is left out: nothing can be found there."""
    width, height = (max(round(side * min(1, MOST_SIDE / max(size))), 1) for side in size)
    drawn = torch.arange(width * height, dtype=torch.int32).view(height, width)
    places = photo.photo().undistort_labels(drawn).numpy()
    x, y = (places % width + 0.5) / width, np.where(places < 0, np.nan, (places // width + 0.5) / height)
    inside = ((left <= x) & (x < right) & (top <= y) & (y < bottom) for left, top, right, bottom in boxes)
    found = (part for mask in inside for part in find_objects(mask.astype(np.uint8)))
    ends = [(c.start, r.start, c.stop, r.stop) for r, c in found]
    return (np.array(ends).reshape(-1, 4) / np.tile(places.shape[::-1], 2)).tolist()


def _matches(true: Float[Array, "n 4"], given: Float[Array, "m 4"]) -> int:
    low, high = np.maximum(true[:, None, :2], given[:, :2]), np.minimum(true[:, None, 2:], given[:, 2:])
    shared = (high - low).clip(0).prod(2)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(1) for boxes in (true, given)]
    same = 2 * shared >= areas[0][:, None] + areas[1] - shared
    return int(same[linear_sum_assignment(same, maximize=True)].sum())
