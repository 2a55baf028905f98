"""Windows, portals and niches: rows of recessed openings in a wall, ray-traced into their depth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lab.landmark.shapes import MISS, NEAREST, Shape, Surface, Vector

DOORS = ("leaves", "panels", "tympanum", "open")
"""Fillings of portals."""


@dataclass(frozen=True, eq=False)
class Openings(Shape):
    """Columns × rows of equal openings on the plane x = 0, facing +x, with y across and z up from 0.

    Each opening is `width` × `height` meters, in the middle of a tile of the `field` (meters). The reveal
    steps inward in `orders`, each `step` meters narrower and depth / orders deeper, as in portals. A band of
    the trim, `surround` meters wide, runs around the opening and belongs to the wall.
    """

    trim_material: int
    field: tuple[float, float]
    columns: int
    rows: int
    width: float
    height: float
    outline: str
    """Outline: a round, pointed or (flat) segment arch, a rectangle (lintel), or a circle (oculus)."""
    filling: str
    """Look of the innermost surface, one of the cases of `_filling`."""
    depth: float
    orders: int
    step: float
    surround: float

    casts_shadow = False

    @property
    def trim(self) -> int:
        return self.trim_material

    @property
    def bounds(self) -> tuple[float, float, float, float, float, float]:
        w, h = self.field
        return -0.01, -w / 2, 0.0, 0.01, w / 2, h

    def distance(self, origin: Vector, direction: Vector) -> np.ndarray:
        t = -origin[0] / direction[0]
        y, z = origin[1] + t * direction[1], origin[2] + t * direction[2]
        w, h = self.field
        hit = (direction[0] < 0) & (t > NEAREST) & (np.abs(y) < w / 2) & (z >= 0) & (z < h)
        # The outline costs more than the plane, so it is computed only where the plane is hit.
        inside = np.flatnonzero(hit)
        if len(inside):
            u, v = self._tile(y.ravel()[inside], z.ravel()[inside])
            hit.ravel()[inside] = self._inside(u, v) > -self.surround
        return np.where(hit, t, MISS)

    def surface(self, point: Vector, direction: Vector, sun: Vector) -> Surface:
        u, v = self._tile(point[1], point[2])
        across, up = direction[1] / -direction[0], direction[2] / -direction[0]
        inset = self._inside(u, v)
        band = inset <= 0
        s, t, depth = u.copy(), v.copy(), np.zeros_like(u)
        open_, jamb = ~band, np.zeros_like(band)
        for order in range(self.orders):
            deeper = self.depth * (order + 1) / self.orders
            u1, v1 = u + deeper * across, v + deeper * up
            inset1 = self._inside(u1, v1) - order * self.step
            hit_jamb = open_ & (inset1 < 0)
            arrived = open_ & ~hit_jamb
            jamb |= hit_jamb
            depth = np.where(open_, deeper, depth)
            s, t, inset = (
                np.where(arrived, new, old) for new, old in ((u1, s), (v1, t), (inset1 - self.step, inset))
            )
            open_ = arrived & (inset >= 0)  # the rest is the face of this step
        bars, dark = self._filling(s, t, inset)
        filled = open_ & ~bars
        shade = np.where(dark & filled, 0.45, 1.0)
        corner = np.clip(0.6 + np.maximum(inset, 0) / max(1.5 * self.depth, 1e-3), 0, 1)
        shade = shade * np.where(open_, corner, np.where(band, 1.08, np.where(jamb, 0.7, 0.92)))
        return Surface(
            normal=self._normal(u, v, jamb), s=s, t=np.where(jamb, v, t), shade=shade,
            sunlit=self._sunlit(s, t, depth, sun) * ~jamb, trim=~filled, element=~band,
            copy=self._number(point[1], point[2]),
        )  # fmt: skip

    def _tile(self, y, z):
        """Return coordinates in the opening's own tile: u from its center line, v from its sill."""
        w, h = self.field[0] / self.columns, self.field[1] / self.rows
        u = np.mod(y + self.field[0] / 2, w) - w / 2
        sill = 0.0 if self.rows == 1 else (h - self.height) / 2
        return u, np.mod(z, h) - sill

    def _number(self, y, z):
        """Number the openings of the field."""
        column = np.floor((y / self.field[0] + 0.5) * self.columns).clip(0, self.columns - 1)
        row = np.floor(z / self.field[1] * self.rows).clip(0, self.rows - 1)
        return (row * self.columns + column).astype(np.int32)

    def _inside(self, u, v):
        """Compute the signed distance to the outline, meters, positive inside the opening."""
        half, height = self.width / 2, self.height
        au = np.abs(u)
        if self.outline == "circle":
            return half - np.hypot(u, v - height / 2)
        if self.outline == "rectangle":
            return np.minimum(half - au, np.minimum(v, height - v))
        radius = {"round": half, "pointed": 2.1 * half, "segment": 1.9 * half}[self.outline]
        sagitta = half  # rise of the arch above its springing
        if self.outline == "pointed":
            sagitta = math.sqrt(radius**2 - (radius - half) ** 2)
        elif self.outline == "segment":
            sagitta = radius - math.sqrt(radius**2 - half**2)
        spring = max(height - sagitta, 0.0)
        if self.outline == "pointed":
            arch = radius - np.hypot(au + radius - half, v - spring)
        elif self.outline == "segment":
            arch = np.minimum(radius - np.hypot(u, v - height + radius), half - au)
        else:
            arch = half - np.hypot(u, v - spring)
        # Portals reach the ground, so there is no band below them.
        foot = v if self.filling not in DOORS else np.maximum(v, 1e-3)
        return np.where(v < spring, np.minimum(half - au, foot), arch)

    def _normal(self, u, v, jamb):
        """Return normals: outward on the wall and the filling, towards the opening's axis on the reveal."""
        rise = np.maximum(v - (self.height - self.width / 2), 0) if self.outline != "rectangle" else 0 * v
        length = np.maximum(np.hypot(u, rise), 1e-6)
        return np.where(jamb, 0.0, 1.0), np.where(jamb, -u / length, 0.0), np.where(jamb, -rise / length, 0.0)

    def _sunlit(self, s, t, depth, sun):
        """Return 1 where the sun reaches a point at `depth` through the outline, else 0."""
        if sun[0] <= 0.02:
            return np.zeros_like(s)
        through = depth / sun[0]
        lit = self._inside(s + through * sun[1], t + through * sun[2]) > 0
        return np.where(lit | (depth == 0), 1.0, 0.0)

    def _filling(self, u, v, inset):
        """Find where bars (of the trim) and dark lines cross the innermost surface."""
        half, height = self.width / 2, self.height
        none = np.zeros(np.shape(u), bool)
        bar = max(0.045 * self.width, 0.05)
        if self.filling in ("leaves", "panels"):
            pitch = half / 3 if self.filling == "leaves" else half
            lines = np.abs(np.mod(u, pitch) - pitch / 2) > pitch / 2 - 0.03 - 0.02 * half
            lines |= np.abs(u) < 0.06 * half
            if self.filling == "panels":
                lines |= np.abs(np.mod(v, height / 5) - height / 10) > height / 10 - 0.06
            lintel = np.abs(v - 0.62 * height) < 0.035 * height
            return lintel, lines
        if self.filling == "tympanum":  # doors below, carved stone in the arch above
            lines = (np.abs(u) < 0.05 * half) | (np.abs(np.mod(u, half / 2) - half / 4) < 0.03)
            return (v > 0.58 * height) | ((np.abs(u) < 0.12 * half) & (v < 0.58 * height)), lines
        if self.filling == "rose":
            y = v - height / 2
            r, angle = np.hypot(u, y) / half, np.arctan2(u, y)
            spokes = np.abs(np.mod(angle * 6 / math.pi, 1) - 0.5) < 0.07 / np.maximum(r, 0.15)
            rings = (np.abs(r - 0.3) < 0.045) | (np.abs(r - 0.68) < 0.035)
            return (spokes & (r > 0.3)) | rings, none
        if self.filling == "tracery":  # two lancets under an oculus
            top = height - half
            oculus = np.abs(np.hypot(u, v - top) - 0.42 * half) < bar
            mullion = (np.abs(u) < bar / 1.5) & (v < top - 0.42 * half)
            lancet = np.hypot(np.abs(u) - half / 2, v - (top - 0.95 * half))
            heads = (np.abs(lancet - 0.45 * half) < bar / 1.5) & (v > top - 0.95 * half) & (v < top)
            return oculus | mullion | heads, none
        if self.filling == "mullion":
            return (np.abs(u) < bar) | (np.abs(v - 0.6 * height) < bar * 0.8), none
        if self.filling == "grid":
            pitch = self.width / 4
            lines = np.abs(np.mod(u, pitch) - pitch / 2) > pitch / 2 - bar / 2
            return lines | (np.abs(np.mod(v, pitch * 1.3) - pitch * 0.65) > pitch * 0.65 - bar / 2), none
        if self.filling == "lattice":
            pitch = self.width / 3
            slanted = [np.abs(np.mod(w, pitch) - pitch / 2) > pitch / 2 - bar / 1.6 for w in (u + v, u - v)]
            return slanted[0] | slanted[1], none
        if self.filling == "louvre":
            pitch = max(height / 9, 0.3)
            return np.mod(v, pitch) < 0.35 * pitch, none
        return none, none  # "plain", "open"
