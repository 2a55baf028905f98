"""Materials of the landmark: palettes and procedural textures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lab.landmark.shapes import floats

# name: (color, pattern, gloss). Colors are linear reflectances.
_KINDS: dict[str, tuple[tuple[float, float, float], str, float]] = {
    "limestone": ((0.62, 0.56, 0.45), "blocks", 0.0),
    "sandstone": ((0.58, 0.42, 0.28), "blocks", 0.0),
    "granite": ((0.42, 0.41, 0.41), "blocks", 0.0),
    "marble": ((0.74, 0.72, 0.68), "slabs", 0.15),
    "red brick": ((0.45, 0.19, 0.12), "bricks", 0.0),
    "yellow brick": ((0.58, 0.46, 0.27), "bricks", 0.0),
    "plaster": ((0.66, 0.58, 0.44), "stains", 0.0),
    "banded stone": ((0.60, 0.50, 0.38), "bands", 0.0),
    "slate": ((0.16, 0.18, 0.21), "tiles", 0.1),
    "clay tile": ((0.45, 0.18, 0.10), "tiles", 0.0),
    "glazed tile": ((0.10, 0.32, 0.40), "tiles", 0.3),
    "lead": ((0.28, 0.31, 0.34), "seams", 0.2),
    "copper": ((0.22, 0.42, 0.35), "seams", 0.05),
    "gold": ((0.72, 0.48, 0.10), "seams", 0.8),
    "wood": ((0.20, 0.11, 0.05), "planks", 0.0),
    "bronze": ((0.14, 0.11, 0.07), "planks", 0.3),
    "glass": ((0.05, 0.06, 0.08), "panes", 0.5),
    "stained glass": ((0.16, 0.15, 0.20), "stained", 0.3),
    "shadow": ((0.025, 0.023, 0.022), "stains", 0.0),
    "grass": ((0.15, 0.24, 0.06), "leaves", 0.0),
    "gravel": ((0.45, 0.38, 0.28), "stains", 0.0),
    "paving": ((0.40, 0.38, 0.35), "slabs", 0.0),
    "foliage": ((0.09, 0.18, 0.04), "leaves", 0.0),
    "bark": ((0.13, 0.09, 0.06), "planks", 0.0),
    "paint": ((0.45, 0.45, 0.45), "plain", 0.5),
    "cloth": ((0.35, 0.35, 0.35), "plain", 0.0),
    "skin": ((0.55, 0.36, 0.26), "plain", 0.0),
    "iron": ((0.05, 0.05, 0.05), "plain", 0.1),
}

MATERIALS = ("sky", *_KINDS)
"""Names in the index order of `Shot.materials`."""
MASONRY = (
    *("limestone", "sandstone", "granite", "marble"),
    *("red brick", "yellow brick", "plaster", "banded stone"),
)
COVERING = ("slate", "clay tile", "glazed tile", "lead", "copper", "gold")


@dataclass(frozen=True, eq=False)
class Material:
    """Material of one landmark: `name` in MATERIALS, its color, texture scale and texture seed."""

    name: str
    color: tuple[float, float, float]
    pattern: str
    scale: float
    seed: int
    gloss: float

    def reflectance(self, s: np.ndarray, t: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Compute colors [n, 3] at texture coordinates. Details below the footprint (meters) fade out."""
        gray = _PATTERNS[self.pattern](s / self.scale, t / self.scale, footprint / self.scale, self.seed)
        weather = 1 + 0.25 * (_noise(s * 0.11, t * 0.05, self.seed + 7) - 0.5)
        colors = floats(self.color) * (gray * weather)[:, None]
        if self.pattern == "stained":
            cells = (np.floor(s / 0.45), np.floor(t / 0.45))
            tint = np.stack([_cell(*cells, self.seed + i) for i in range(3)], axis=1)
            colors *= 0.3 + 1.7 * tint
        return colors


def make_material(name: str, rng: np.random.Generator, tint: float = 0.04) -> Material:
    """Make a landmark's version of a material, brighter or darker, and warmer or colder by up to `tint`."""
    color, pattern, gloss = _KINDS[name]
    if name == "glazed tile" and rng.random() < 0.4:
        color = [(0.08, 0.18, 0.45), (0.12, 0.38, 0.22), (0.45, 0.42, 0.36)][rng.integers(3)]
    warmth = 1 + rng.uniform(-2 * tint, 2 * tint) * np.array([1, 0.2, -1])
    shifted = np.array(color) * rng.uniform(0.8, 1.2) * warmth
    r, g, b = np.clip(shifted, 0.015, 0.9).tolist()
    return Material(name, (r, g, b), pattern, float(rng.uniform(0.8, 1.35)), int(rng.integers(1000)), gloss)


def colored(name: str, rng: np.random.Generator) -> Material:
    """Make cloth or paint of a random color."""
    material = make_material(name, rng)
    r, g, b = rng.uniform(0.03, 0.75, 3).tolist()
    return replace(material, color=(r, g, b))


def _random_tables() -> tuple[np.ndarray, np.ndarray]:
    """Make white noise per cell [128, 128], and smooth periodic noise, 16 samples per period [512, 512]."""
    rng = np.random.default_rng(20)
    white = rng.random((128, 128), dtype=np.float32)
    lattice = rng.random((32, 32), dtype=np.float32)
    x = np.arange(512) / 16
    i, f = x.astype(int), (x % 1).astype(np.float32)
    f = f * f * (3 - 2 * f)
    rows = lattice[i] * (1 - f)[:, None] + lattice[(i + 1) % 32] * f[:, None]
    return white, np.ascontiguousarray(rows[:, i] * (1 - f) + rows[:, (i + 1) % 32] * f)


_WHITE, _SMOOTH = _random_tables()


def _cell(i, j, seed: int) -> np.ndarray:
    """Look up a random number in [0, 1) for every cell (i, j)."""
    row, column = (j.astype(np.int32) + 17 * seed) & 127, (i.astype(np.int32) + 31 * seed) & 127
    return _WHITE.take(row * 128 + column)  # faster than indexing with two arrays


def _noise(x, y, seed: int = 0) -> np.ndarray:
    """Compute smooth noise in [0, 1] with features one unit in size."""
    row = ((y * 16).astype(np.int32) + 91 * seed) & 511
    column = ((x * 16).astype(np.int32) + 37 * seed) & 511
    return _SMOOTH.take(row * 512 + column)


def fractal_noise(x, y, seed: int, octaves: int = 4) -> np.ndarray:
    """Sum noise octaves of halving size and weight, scaled to [0, 1]."""
    total = sum(_noise(x * 2**i, y * 2**i, seed + i) / 2**i for i in range(octaves))
    return total / (2 - 2 ** (1 - octaves))


def resolved(size: float, footprint) -> np.ndarray:
    """Return 1 if a detail of this size is resolved, falling to 0 if it is finer than one footprint."""
    return np.clip(size / (2 * footprint) - 0.5, 0, 1)


def _courses(
    s, t, footprint, seed: int, width: float, height: float, joint: float, contrast: float
) -> np.ndarray:
    """Render masonry: courses of stones in slightly different grays, with dark joints."""
    row = np.floor(t / height)
    x = s / width + 0.5 * np.mod(row, 2)
    column = np.floor(x)
    in_joint = ((x - column) * width < joint) | ((t / height - row) * height < joint)
    joints = 1 - np.float32(0.3) * in_joint * resolved(2 * joint, footprint)
    return (1 + contrast * (_cell(column, row, seed) - 0.5) * resolved(height, footprint)) * joints


def _blocks(s, t, footprint, seed) -> np.ndarray:
    grain = 1 + 0.16 * (_noise(s * 2.1, t * 2.1, seed) - 0.5) * resolved(0.5, footprint)
    return _courses(s, t, footprint, seed, 1.0, 0.48, 0.04, 0.36) * grain


def _slabs(s, t, footprint, seed) -> np.ndarray:
    veins = 1 + 0.25 * (fractal_noise(s * 0.5, t * 0.5, seed, 3) - 0.5)
    return _courses(s, t, footprint, seed, 1.5, 1.5, 0.04, 0.14) * veins


def _bricks(s, t, footprint, seed) -> np.ndarray:
    shades = 1 + 0.2 * (_noise(s * 0.4, t * 0.4, seed) - 0.5)
    return _courses(s, t, footprint, seed, 0.4, 0.14, 0.025, 0.5) * shades


def _bands(s, t, footprint, seed) -> np.ndarray:
    course = np.where(np.mod(t / 0.9, 2) < 1, np.float32(1.15), np.float32(0.62))
    shown = resolved(0.9, footprint)
    return (course * shown + 0.88 * (1 - shown)) * _courses(s, t, footprint, seed, 1.4, 0.9, 0.04, 0.15)


def _seams(s, t, footprint, seed) -> np.ndarray:
    seam = np.float32(0.4) * (np.mod(s, 1.1) < 0.13) * resolved(0.3, footprint)
    return 1 - seam + 0.25 * (_noise(s * 0.8, t * 0.3, seed) - 0.5)


def _planks(s, t, footprint, seed) -> np.ndarray:
    joint = np.float32(0.4) * (np.mod(s, 0.35) < 0.05) * resolved(0.1, footprint)
    return (1 - joint) * (1 + 0.3 * (_cell(np.floor(s / 0.35), np.zeros_like(s), seed) - 0.5))


def _panes(s, t, footprint, seed) -> np.ndarray:
    return 0.6 + 0.9 * _cell(np.floor(s / 0.4), np.floor(t / 0.4), seed) * resolved(0.4, footprint)


_PATTERNS: dict[str, Callable[..., np.ndarray]] = {
    "blocks": _blocks,
    "slabs": _slabs,
    "bricks": _bricks,
    "stains": lambda s, t, _, seed: 1 + 0.3 * (fractal_noise(s * 0.3, t * 0.2, seed, 3) - 0.5),
    "bands": _bands,
    "tiles": lambda s, t, footprint, seed: _courses(s, t, footprint, seed, 0.45, 0.4, 0.07, 0.5),
    "seams": _seams,
    "planks": _planks,
    "panes": _panes,
    "stained": _panes,
    "leaves": lambda s, t, _, seed: 1 + 0.9 * (fractal_noise(s * 0.8, t * 0.8, seed, 4) - 0.5),
    "plain": lambda s, t, _, seed: 1 + 0.1 * (_noise(s, t, seed) - 0.5),
}
