"""Viewer camera flights to a photo's viewpoint."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lang3dxl_ns.query.match import Found, Viewpoint
from lang3dxl_ns.scene.camera import Camera


@dataclass(frozen=True)
class Stand:
    """Pose of the viewer's camera: without roll, which its controls lack. The model's axes, z up."""

    position: np.ndarray
    """[3]."""
    look_at: np.ndarray
    """[3], orbit center."""
    fov: float
    """Vertical field of view, radians."""


def stand_of(camera: Camera, aspect: float, target: tuple[float, ...] | None = None) -> Stand:
    """A photo's viewpoint in a window of this aspect ratio (width ÷ height), with all of the photo in view.

    target: orbit center, moved onto the photo's axis at its distance; None: a unit away.
    """
    view = camera.view_matrix.double().cpu().numpy()
    forward, position = view[2, :3], -view[:3, :3].T @ view[:3, 3]
    ahead = 1.0 if target is None else float((np.asarray(target) - position) @ forward)
    k = camera.intrinsics.double().cpu().numpy()
    half_height = max(k[1, 2], camera.height - k[1, 2]) / k[1, 1]
    half_width = max(k[0, 2], camera.width - k[0, 2]) / k[0, 0]
    fov = 2 * math.atan(max(half_height, half_width / aspect))
    return Stand(position, position + max(ahead, 0.05) * forward, fov)


def flight(start: Stand, end: Stand, steps: int) -> Iterator[Stand]:
    """Path from one stand to another, slow at both ends; the last is `end`.

    Around the orbit center instead of through it: turn, height and distance change evenly.
    """
    here, there = _around(start), _around(end)
    there[0] = here[0] + math.remainder(there[0] - here[0], math.tau)  # the shorter way round
    for step in range(1, steps):
        t = step / steps
        t = t * t * (3 - 2 * t)
        look_at = (1 - t) * start.look_at + t * end.look_at
        turn, height, distance = (1 - t) * here + t * there
        offset = [math.cos(turn) * math.cos(height), math.sin(turn) * math.cos(height), math.sin(height)]
        fov = (1 - t) * start.fov + t * end.fov
        yield Stand(look_at + distance * np.array(offset), look_at, fov)
    yield end


def _around(stand: Stand) -> np.ndarray:
    """Direction (turn about the vertical, elevation; radians) and distance of the camera from its orbit
    center."""
    x, y, z = stand.position - stand.look_at
    return np.array([math.atan2(y, x), math.atan2(z, math.hypot(x, y)), math.sqrt(x * x + y * y + z * z)])


class Tour:
    """Cyclic tour of a prompt's viewpoints."""

    def __init__(self, found: Found) -> None:
        self.found = found
        self.place = -1
        """Index of the viewpoint shown; −1: none yet."""

    def best(self) -> Viewpoint:
        """The best viewpoint."""
        self.place = 0
        return self.found.views[0]

    def move(self, step: int) -> Viewpoint:
        """The viewpoint `step` further on; at first, forward leads to the best, backward to the last."""
        nowhere = 0 if step < 0 else -1
        self.place = ((nowhere if self.place < 0 else self.place) + step) % len(self.found.views)
        return self.found.views[self.place]

    def __str__(self) -> str:
        viewpoint = self.found.views[self.place]
        return (
            f"{self.place + 1} of {len(self.found.views)}: {viewpoint.name}, "
            f"{viewpoint.area:.0%} of it matches"
        )


def box_lines(low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    """[16, 3] corners of a box in an order that draws all its edges in one line."""
    path = ("000", "100", "110", "010", "000", "001", "101", "100", "101", "111", "110", "111", "011", "010",
            "011", "001")  # fmt: skip
    ends = np.array([low, high], dtype=np.float64)
    return np.array([[ends[int(side), axis] for axis, side in enumerate(corner)] for corner in path])
