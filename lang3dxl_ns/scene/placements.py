"""Doubtful placements of photos in a reconstruction, as on a building that looks alike from several sides.

A photo on the wrong side agrees with the photos there, since they look alike, and contradicts its true
neighbors: the rotation between two photos, measured from their matches alone, then differs from the model's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from multiprocessing.pool import ThreadPool
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.scene.colmap import load_pycolmap
from lang3dxl_ns.scene.reconstruction import CONTRADICTED, LONELY

if TYPE_CHECKING:
    import pycolmap

LEAST_MATCHES = 15
"""Fewest verified matches of a pair of photos that is considered, as in COLMAP's mapper."""
SOUND = 4.0, 1.5
"""Largest error in pixels and smallest angle in degrees of a point, as in COLMAP's mapper."""
_ERROR = 0.004
"""Largest error in pixels of a match that agrees with a rotation, relative to the photo's longer side."""
APART = 20.0
"""Degrees between the measured and the model's rotation above which they contradict each other."""


@dataclass(frozen=True)
class MatchedPair:
    """Two photos by their numbers, and their relative rotation as measured from their matches alone."""

    first: int
    second: int
    matches: int
    """Number of matches that agree on the rotation."""
    turn: Float[Array, "3 3"]
    """Rotation from the first camera to the second."""


def doubtful_placements(
    rotations: Mapping[int, Float[Array, "3 3"]], pairs: Iterable[MatchedPair]
) -> dict[int, str]:
    """Find photos that are doubtfully placed, with reasons; rotations: world → camera in the model. Either
    more matches contradict a photo's placement than support it, or only one other photo supports it."""
    reasons: dict[int, str] = {}

    def contradicts(pair: MatchedPair) -> bool:
        between = rotations[pair.first] @ rotations[pair.second].T @ pair.turn
        return bool(np.degrees(Rotation.from_matrix(between).magnitude()) > APART)

    judged = [(pair, contradicts(pair)) for pair in pairs]
    while True:  # the most contradicted first, since its pairs would accuse its neighbors
        supporting, contradicting, supporters = Counter[int](), Counter[int](), Counter[int]()
        for pair, contradicted in judged:
            if pair.first in reasons or pair.second in reasons:
                continue
            for photo in (pair.first, pair.second):
                (contradicting if contradicted else supporting)[photo] += pair.matches
                supporters[photo] += not contradicted
        accused = contradicting - supporting
        if not accused:
            break
        worst = max(accused, key=accused.__getitem__)
        reasons[worst] = CONTRADICTED
    lonely = [p for p in rotations if p not in reasons and supporters[p] < 2 and len(rotations) > 3]
    return reasons | dict.fromkeys(lonely, LONELY)


def matched_pairs(database: pycolmap.Database, cameras: Mapping[int, pycolmap.Camera]) -> list[MatchedPair]:
    """List the verified pairs among photos with these cameras (by the photos' numbers), except those with few
    matches. Rotations follow from the lenses: fundamental matrices without them, as the database has, leave
    them open where matches lie on one wall."""
    pycolmap = load_pycolmap()
    points = {number: database.read_keypoints(number)[:, :2].astype(float) for number in cameras}

    def measured(pair: tuple[int, int, Int[Array, "m 2"]]) -> MatchedPair | None:
        first, second, ends = pair
        pixels = points[first][ends[:, 0]], points[second][ends[:, 1]]
        seen_by = cameras[first], cameras[second]
        error = _ERROR * max(max(camera.width, camera.height) for camera in seen_by)
        ransac = {"max_error": error, "min_num_trials": 100, "random_seed": 0}
        found = pycolmap.estimate_essential_matrix(*pixels, *seen_by, ransac)
        if not found or found["num_inliers"] < LEAST_MATCHES:
            return None
        return MatchedPair(first, second, found["num_inliers"], found["cam2_from_cam1"].rotation.matrix())

    matched = []
    for key, count in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
        first, second = pycolmap.pair_id_to_image_pair(key)
        if count >= LEAST_MATCHES and first in cameras and second in cameras:
            ends = np.asarray(database.read_two_view_geometry(first, second).inlier_matches)
            matched.append((first, second, ends))
    # COLMAP's library lets other threads go on meanwhile, and Ctrl+C waits for no other pair.
    with ThreadPool() as cores:
        return [*filter(None, tracked(cores.imap(measured, matched), "pairs measured", len(matched)))]


def cameras_of(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Camera]:
    """Return the cameras of a model's photos with a pose, by the photos' numbers."""
    return {i: model.cameras[image.camera_id] for i, image in model.images.items() if image.has_pose}


def rotations_of(model: pycolmap.Reconstruction) -> dict[int, Float[Array, "3 3"]]:
    """Return the rotations (world → camera) of the model's photos, by number."""
    posed = (image for image in model.images.values() if image.has_pose)
    return {image.image_id: image.cam_from_world().rotation.matrix() for image in posed}
