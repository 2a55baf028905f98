"""What hiding floaters hides: of floaters, and of the building, by the exact geometry of generated landmarks.

    python -m lab.benchmarks.floaters FOLDER [FOLDER …]

A folder is one of `lang3dxl demo`. A Gaussian that photos show is a floater if it lies before a surface that
one of them sees, and farther from all of them than 4 % of the building's height. It is part of the building
if it lies within half of that, and as high above the ground. What lies behind everything is sky.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lab.landmark.landmark import Landmark
from lab.landmark.raycast import Camera, cast
from lab.landmark.shapes import MISS
from lang3dxl_ns.open_scene import load_scene
from lang3dxl_ns.query.floaters import FLOATS
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.scene.camera import resized

TOLERANCE = 0.04
"""Distance from all surfaces, in building heights, beyond which a Gaussian is a floater."""
_SIDE = 320


def surfaces(scene: Scene, landmark: Landmark, similarity: dict) -> tuple[np.ndarray, ...]:
    """Measure every Gaussian's distance from the surfaces that photos see, meters [n], whether it lies before
    one of them [n], and its height above the ground, meters [n]. similarity: COLMAP's frame from meters, as
    in a demo's scene.json."""
    frame, turn = np.array(scene.file.transform), np.array(similarity["rotation"])
    matrix = scene.file.scale * frame[:, :3] @ (similarity["scale"] * turn)
    origin = scene.file.scale * (frame[:, :3] @ np.array(similarity["translation"]) + frame[:, 3])
    meters = np.linalg.inv(matrix).T
    places = (scene.splats.means.double().cpu().numpy() - origin) @ meters
    points, before = [], np.zeros(len(places), bool)
    for photo in scene.photos:
        view = resized(photo.camera, _SIDE)
        axes = meters.T @ photo.pose[:3, :3] @ np.diag([1, -1, -1])
        axes /= np.cbrt(np.linalg.det(axes))
        focal = float(view.intrinsics[0, 0]) / max(view.width, view.height)
        camera = Camera((photo.pose[:3, 3] - origin) @ meters, axes.T, focal)
        depth, _ = cast(landmark.shapes, camera, view.width, view.height)
        start, ways = camera.rays(view.width, view.height)
        hit = depth < MISS / 2
        points.append(np.stack([(s + depth * w)[hit] for s, w in zip(start, ways, strict=True)], axis=1))
        x, y, z = camera.project(places, view.width, view.height).T
        seen = np.flatnonzero((z > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height))
        there = y[seen].astype(int), x[seen].astype(int)
        before[seen] |= hit[there] & (z[seen] < depth[there])
    return cKDTree(np.concatenate(points)[::2]).query(places)[0], before, places[:, 2]


def measure(folder: Path) -> dict[str, float]:
    """Measure the shares of floaters and of the building that are hidden, by count and by pixels."""
    told = json.loads((folder / "scene" / "scene.json").read_text())
    landmark = Landmark.from_seed(told["seed"], told["family"])
    scene = load_scene(next(folder.glob("run/**/*.scene")))
    distance, before, rise = surfaces(scene, landmark, told["colmap_from_meters"])
    away, above = distance / landmark.height, rise / landmark.height
    mass, hidden = scene.mass.cpu().numpy(), scene.floating.cpu().numpy() > FLOATS
    floaters = (away > TOLERANCE) & before & (mass > 1)
    solid = (away < TOLERANCE / 2) & (above > TOLERANCE / 2) & (mass > 1)
    return {
        "floaters": float(hidden[floaters].mean()),
        "floaters, by pixels": float(mass[floaters & hidden].sum() / mass[floaters].sum()),
        "building": float(hidden[solid].mean()),
        "building, by pixels": float(mass[solid & hidden].sum() / mass[solid].sum()),
    }


if __name__ == "__main__":
    for name in sys.argv[1:]:
        print(name, *(f"{what} {share:.1%}" for what, share in measure(Path(name)).items()), sep="; ")
