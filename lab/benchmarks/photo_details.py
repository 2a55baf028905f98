"""How alike photos of generated landmarks are to real ones, in what reconstruction lives on.

    python -m lab.benchmarks.photo_details SCENE …

Each SCENE has images/ and sparse/0; at most 8 of its photos are read. The table gives SIFT's features per
megapixel, the share of features unlike all others of their photo, the share unlike all of a photo that looks
the other way, and the matches of a pair that agree with its true poses, by the angle between the views.
"""

from __future__ import annotations

import sys
from itertools import combinations, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
from jaxtyping import Bool, Float
from numpy import ndarray as Array

_PHOTOS = 8
_ALIKE = 0.9  # cosine of descriptors from which they can be taken for each other
_OTHER_SIDE = 120  # degrees
_NEAR = 0.004  # distance from the epipolar line, relative to the longer side
_RATIO = 0.8
_ANGLES = (0, 15, 30, 60, 180)


def row(scene: Path) -> str:
    """A line of the table."""
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda image: image.name)
    images = images[:: max(len(images) // _PHOTOS, 1)][:_PHOTOS]
    pixels, looks, size = {}, {}, {}
    with TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        options = pycolmap.FeatureExtractionOptions(
            max_image_size=1600, num_threads=2, sift={"max_num_features": 16_384}
        )
        names = [image.name for image in images]
        pycolmap.extract_features(database, scene / "images", names, extraction_options=options)
        with pycolmap.Database.open(database) as db:
            for image in images:
                stored = db.read_image_with_name(image.name)
                assert stored is not None
                camera, own = db.read_camera(stored.camera_id), model.cameras[image.camera_id]
                scale = [own.width / camera.width, own.height / camera.height]
                pixels[image.name] = db.read_keypoints(stored.image_id)[:, :2] * scale
                found = db.read_descriptors(stored.image_id).data.astype(np.float32)
                looks[image.name] = found / np.linalg.norm(found, axis=1, keepdims=True)
                size[image.name] = camera.width * camera.height / 1e6
    density = np.median([len(pixels[name]) / size[name] for name in names])
    alone = np.mean([_unlike(looks[n] @ looks[n].T - 2 * np.eye(len(looks[n]))) for n in names])
    other: list[float] = []
    by_angle: dict[int, list[int]] = {low: [] for low in _ANGLES[:-1]}
    for a, b in combinations(images, 2):
        ways = [image.viewing_direction() for image in (a, b)]
        angle = np.degrees(np.arccos(np.clip(ways[0] @ ways[1], -1, 1)))
        cosines = looks[a.name] @ looks[b.name].T
        if angle > _OTHER_SIDE:
            other.append(_unlike(cosines))
        matches = _agreeing(model, (a, b), cosines, (pixels[a.name], pixels[b.name]))
        by_angle[max(low for low in by_angle if low <= angle)].append(matches)
    apart = f"{np.mean(other):.2f}" if other else "–"
    falls = [f"{np.median(found):.0f}" if found else "–" for found in by_angle.values()]
    return " | ".join(["", scene.name, f"{density:.0f}", f"{alone:.2f}", apart, *falls, ""]).strip()


def _unlike(cosines: Float[Array, "n m"]) -> float:
    return float((cosines.max(axis=1) < _ALIKE).mean())


def _agreeing(
    model: pycolmap.Reconstruction,
    pair: tuple[pycolmap.Image, pycolmap.Image],
    cosines: Float[Array, "n m"],
    pixels: tuple[Float[Array, "n 2"], Float[Array, "m 2"]],
) -> int:
    """Count mutual matches that the true poses allow."""
    nearest = np.argpartition(-cosines, 1, axis=1)[:, :2]
    two = np.sqrt(2 - 2 * np.take_along_axis(cosines, nearest, 1).clip(-1, 1))
    best = nearest[np.arange(len(two)), two.argmin(axis=1)]
    kept: Bool[Array, " n"] = two.min(axis=1) < _RATIO * two.max(axis=1)
    kept &= cosines.argmax(axis=0)[best] == np.arange(len(best))
    cameras = [model.cameras[image.camera_id] for image in pair]
    first, second = (
        np.column_stack([camera.cam_from_img(points), np.ones(len(points))])
        for camera, points in zip(cameras, (pixels[0][kept], pixels[1][best[kept]]), strict=True)
    )
    between = pair[1].cam_from_world() * pair[0].cam_from_world().inverse()
    lines = first @ pycolmap.essential_matrix_from_pose(between).T
    apart = np.abs((lines * second).sum(1)) / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    near = _NEAR * max(cameras[1].width, cameras[1].height) / cameras[1].mean_focal_length()
    return int((apart < near).sum())


if __name__ == "__main__":
    steps = [f"{low}–{high}°" for low, high in pairwise(_ANGLES)]
    heads = ["scene", "features per MP", "unlike own photo", "unlike other side", *steps]
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for place in sys.argv[1:]:
        print(row(Path(place)), flush=True)
