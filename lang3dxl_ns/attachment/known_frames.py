"""Frames in which programs train splats, as similarities from the frame of the photos' poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from lang3dxl_ns.common.checks import FARTHEST, expect
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import DAMAGE
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.scene.colmap import Reconstruction

Similarity = Float[Array, "4 4"]
"""Similarity [[s·R, t], [0, 1]] from the photos' frame to the splat's."""
RUN_TRANSFORM = "dataparser_transforms.json"
"""File to which nerfstudio writes a run's frame."""
_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Rotation from COLMAP's y down to nerfstudio's z up."""
_OLD_Z_UP = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""Rotation from COLMAP's y down to z up in nerfstudio before 1.0."""
_HALF_TURNS = {"x": np.diag([1.0, -1, -1, 1]), "y": np.diag([-1.0, 1, -1, 1]), "z": np.diag([-1.0, -1, 1, 1])}
_STEPS, _POINTS, _GAUSSIANS = 30, 2_000, 20_000
_FEWEST = 50
"""Smallest number of points, and of Gaussians, that are aligned by shape."""
_MOST_SHRUNK = 1e-3
"""Size of a fitted shape, relative to the splat's, below which the fit is a collapse."""


def known_frames(reconstruction: Reconstruction, splat: Path) -> dict[str, Similarity]:
    """List a splat's possible frames by program. A file beside the splat gives that of a nerfstudio run."""
    cameras = [np.vstack([p.camera_from_world, [0, 0, 0, 1]]) for p in reconstruction.photos.values()]
    poses = np.linalg.inv(np.array(cameras, np.float64))
    frames = _of_run(splat)
    frames["the photos' own, as in 3D Gaussian splatting"] = np.eye(4)
    for name, axes in {"": np.eye(4), ", with z up": _Z_UP, ", as before version 1.0": _OLD_Z_UP}.items():
        moved = axes @ poses
        frames[f"nerfstudio's{name}"] = _centered(moved, _turned(-moved[:, :3, 1], (0, 0, 1))) @ axes
        frames[f"centered and scaled{name}"] = _centered(moved, np.eye(4)) @ axes
    frames |= _gsplat(poses, reconstruction.points)
    return frames | {f"the photos' own, turned about {name}": turn for name, turn in _HALF_TURNS.items()}


def _of_run(splat: Path) -> dict[str, Similarity]:
    for folder in splat.parents[:2]:
        try:
            content = read_json(folder / RUN_TRANSFORM)
            rows = np.array(content["transform"], np.float64).reshape(3, 4) * float(content["scale"])
            sound = np.abs(rows).max() < FARTHEST and np.linalg.det(rows[:, :3]) > 0  # not flat or mirrored
            expect(bool(sound), "it is no frame")
        except DAMAGE:
            continue
        own = np.vstack([rows, [0, 0, 0, 1]])
        # A transforms.json of ns-process-data already has turned axes.
        return {"the run's": own, "the run's, of turned axes": own @ np.linalg.inv(_Z_UP)}
    return {}


def _turned(axes: Float[Array, "n 3"], target: tuple[int, int, int]) -> Similarity:
    """Compute the smallest rotation that takes the mean of some directions to another direction."""
    turn, mean = np.eye(4), axes.mean(axis=0)
    if (length := np.linalg.norm(mean)) > 1e-9:  # opposite directions have no mean
        turn[:3, :3] = Rotation.align_vectors([target], [mean / length])[0].as_matrix()
    return turn


def _centered(poses: Float[Array, "n 4 4"], turn: Similarity) -> Similarity:
    """Turn the frame, move the cameras' mean to the origin, and scale their largest coordinate to 1."""
    shift = np.eye(4)
    shift[:3, 3] = -poses[:, :3, 3].mean(axis=0)
    moved = (turn @ shift @ poses)[:, :3, 3]
    return _scaled(1 / max(float(np.abs(moved).max()), 1e-12)) @ turn @ shift


def _scaled(factor: float) -> Similarity:
    return np.diag([factor, factor, factor, 1.0])


def _gsplat(poses: Float[Array, "n 4 4"], points: Float[Array, "m 3"]) -> dict[str, Similarity]:
    """Compute the normalization of gsplat's examples: up is −y, the origin is where the cameras look, and the
    median camera is at distance 1. Then the points' principal axes follow, the smallest variance at z."""
    turn = _turned(-poses[:, :3, 1], (0, -1, 0))
    turned = turn @ poses
    places, forward = turned[:, :3, 3], turned[:, :3, 2]
    nearest = places - (forward * places).sum(1, keepdims=True) * forward
    shift = np.eye(4)
    shift[:3, 3] = -np.median(nearest, axis=0)
    distance = np.median(np.linalg.norm(places + shift[:3, 3], axis=1))
    first = _scaled(1 / max(float(distance), 1e-12)) @ shift @ turn
    frames = {"gsplat's, without points": first}
    if len(points) < 4:
        return frames
    middle, axes, _ = _principal(points @ first[:3, :3].T + first[:3, 3])
    principal = np.eye(4)
    principal[:3, :3], principal[:3, 3] = axes.T, -axes.T @ middle
    frames["gsplat's"] = principal @ first
    # Versions differ in the signs of the axes.
    return frames | {f"gsplat's, turned about {n}": t @ principal @ first for n, t in _HALF_TURNS.items()}


def registered_frames(points: Float[Array, "m 3"], means: Float[Array, "n 3"]) -> dict[str, Similarity]:
    """Register the photos' points to the Gaussians by iterated closest points from many rotations, and return
    the three closest similarities. With fewer than 50 points or Gaussians there are none, and for flat or
    thin shapes there may be none; a message says so."""
    if len(points) < _FEWEST or len(means) < _FEWEST:
        say(f"too few to align by shape: {len(points)} points of the photos, {len(means)} opaque Gaussians")
        return {}
    chosen = np.random.default_rng(0)
    source, target = (
        chosen.permutation(_typical(cloud))[:count]
        for cloud, count in ((points, _POINTS), (means, _GAUSSIANS))
    )
    tree, starts = KDTree(target), Rotation.create_group("O").as_matrix()
    fits = sorted((_closest(source, target, tree, start) for start in starts), key=lambda fit: fit[0])
    found = {f"by its shape, {i + 1}": fit for i, (score, fit) in enumerate(fits[:3]) if np.isfinite(score)}
    if not found:
        say("the splat can't be aligned to the photos' points by its shape, which is flat or thin")
    return found


def _typical(points: Float[Array, "m 3"]) -> Float[Array, "k 3"]:
    """Select the nine tenths of the points that are nearest to the middle."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return points[distance <= np.quantile(distance, 0.9)]


def _closest(
    source: Float[Array, "m 3"], target: Float[Array, "n 3"], tree: KDTree, turn: Float[Array, "3 3"]
) -> tuple[float, Similarity]:
    """Run iterated closest points from principal axes and a rotation. Returns mean distance / size, fit."""
    from skimage.transform import estimate_transform  # takes a second to import

    (a, from_axes, small), (b, to_axes, size) = map(_principal, (source, target))
    fit, distance, size = np.eye(4), np.inf, max(size, 1e-12)
    fit[:3, :3] = size / max(small, 1e-12) * to_axes @ turn @ from_axes.T
    fit[:3, 3] = b - fit[:3, :3] @ a
    for _ in range(_STEPS):
        near, rows = tree.query(source @ fit[:3, :3].T + fit[:3, 3])
        kept = near <= np.quantile(near, 0.8)
        distance = float(near[kept].mean() / size)
        found = estimate_transform("similarity", source[kept], target[rows[kept]])
        if not found or not np.isfinite(found.params).all():  # places in a line, or in one point
            return np.inf, fit
        fit = found.params
    # A fit that shrinks everything onto one place is close, too, so shrinking is penalized.
    shrunk = small * np.cbrt(np.linalg.det(fit[:3, :3])) / size
    return (distance * max(1.0, 1 / shrunk) if shrunk > _MOST_SHRUNK else np.inf), fit


def _principal(points: Float[Array, "m 3"]) -> tuple[Float[Array, "3"], Float[Array, "3 3"], float]:
    """Return points' middle, principal axes (columns, largest variance first) and mean distance to middle."""
    middle = np.median(points, axis=0)
    axes = np.linalg.eigh(np.cov(points - middle, rowvar=False))[1][:, ::-1].copy()
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return middle, axes, float(np.linalg.norm(points - middle, axis=1).mean())
