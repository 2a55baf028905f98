"""A scene whose answers are known: a flat wall painted with a dome and two windows, seen by three cameras.

from painted_scene import painted_scene
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from lang3dxl_ns.geometry import camera_to_world
from lang3dxl_ns.query.scene import QueryConfig, Scene, View
from lang3dxl_ns.query.scene_file import SceneFile, ScenePhoto
from lang3dxl_ns.rendering import Camera

WORDS = ("wall", "dome", "window", "object")
CODES = torch.tensor([[-2.0, -2.0, 0.0], [2.0, -2.0, 0.5], [0.0, 2.0, -0.5], [0.0, 0.0, 3.0]])
"""Code of each word; the decoder turns a code into the word that is nearest, smoothly."""
DISTANCE = 5.0
"""Of all cameras from the wall, which is the plane z = 0."""
DOME = (1.0, 2.0, 1.0, 2.0)
"""x from, to, y from, to."""
WINDOWS = ((-2.0, -1.6, -1.0, -0.6), (-1.0, -0.6, -1.0, -0.6))
CHANNELS = 16


def decode(codes: Tensor) -> Tensor:
    closeness = (-(codes[:, None] - CODES.to(codes)).square().sum(2)).softmax(1)
    closeness[:, WORDS.index("object")] += 0.2  # everything is a bit of an object
    return torch.cat([closeness, closeness.new_zeros(len(codes), CHANNELS - len(WORDS))], dim=1)


def encode_texts(texts: list[str]) -> Tensor:
    """A word's vector is its axis; other texts lie on axes of their own, more or less."""
    rows = torch.zeros(len(texts), CHANNELS)
    for row, text in zip(rows, texts, strict=True):
        first = text.split(",")[0].removesuffix("s")
        row[WORDS.index(first) if first in WORDS else 4 + sum(text.encode()) % 12] = 3.0
    return rows


def word_at(points: Tensor) -> Tensor:
    """Index of the word at points of the wall [..., 2]."""
    words = torch.zeros(points.shape[:-1], dtype=torch.long)
    for word, (left, right, bottom, top) in ((1, DOME), *((2, window) for window in WINDOWS)):
        x, y = points[..., 0], points[..., 1]
        words[(x > left) & (x < right) & (y > bottom) & (y < top)] = word
    return words


def render(camera: Camera) -> View:
    rows, columns = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    k, position = camera.intrinsics, -camera.view_matrix[:3, 3]
    x = (columns - k[0, 2]) / k[0, 0] * DISTANCE + position[0]
    y = (rows - k[1, 2]) / k[1, 1] * DISTANCE + position[1]
    alpha = ((x.abs() < 3) & (y.abs() < 3)).float()
    words = word_at(torch.stack([x, y], dim=2))
    # A little noise, as rendered codes have.
    noise = 0.05 * torch.randn(*words.shape, 3, generator=torch.Generator().manual_seed(0))
    codes = (CODES[words] + noise) * alpha[..., None]
    return View(camera, words[..., None].expand(-1, -1, 3) / 3.0, codes, alpha, torch.full_like(x, DISTANCE))


def photo(name: str, x: float, y: float, split="train", focal: int = 96, size: int = 96) -> ScenePhoto:
    view = torch.eye(4)
    view[:3, 3] = -torch.tensor([x, y, -DISTANCE])
    middle = size / 2
    return ScenePhoto(name, split, camera_to_world(view).tolist(), focal, focal, middle, middle, size, size)


def painted_scene(cache_dir: Path | None = None, config: QueryConfig | None = None, **changes) -> Scene:
    photos = [
        photo("left/0001.jpg", -1.5, -1),
        photo("right/0002.jpg", 1.5, 1.5),
        photo("all/0003.jpg", 0, 0, focal=70),
    ]
    photos.append(photo("held/0004.jpg", 0.5, 0.5, "eval"))
    file = SceneFile(photos, "clip", "0123", 1.0, torch.eye(4)[:3].tolist(), "nowhere")
    gaussians = {"means": torch.zeros(4, 3), "codes": CODES.clone()}
    parts = {"render": render, "decode": decode, "bounded": True, "gaussians": gaussians, "file": file}
    parts |= {"encode_texts": encode_texts, "state": gaussians, "cache_dir": cache_dir, "config": config}
    return Scene(**{**parts, **changes})
