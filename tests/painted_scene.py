"""A scene with known answers: a flat wall painted with a dome and two windows, seen by three cameras.

from painted_scene import painted_scene
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from lang3dxl_ns.components.appearance import AppearanceConfig, AppearanceField
from lang3dxl_ns.components.decoders import DecoderConfig, make_decoder
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.semantic_field import SemanticFieldConfig
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.rendering import Splats, harmonics_of
from lang3dxl_ns.scene.camera import Lens, camera_to_world
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord

WORDS = ("wall", "dome", "window", "object")
DISTANCE = 5.0
"""Distance of all cameras from the wall, which is the plane z = 0."""
DOME = (1.0, 2.0, 1.0, 2.0)
"""x from, to, y from, to."""
WINDOWS = ((-2.0, -1.6, -1.0, -0.6), (-1.0, -0.6, -1.0, -0.6))
CHANNELS = 16
TICKS = 8
"""Gaussians along a unit of the wall: a browser without a GPU takes a second to draw 40,000."""
COUNT = (6 * TICKS) ** 2 + 1
"""Gaussians of the scene."""


def features() -> Tensor:
    """Unit feature of each word."""
    rows = torch.eye(len(WORDS), CHANNELS)
    rows[:, WORDS.index("object")] += 0.2  # everything is a bit of an object
    return F.normalize(rows, dim=1)


def encode_texts(texts: list[str]) -> Tensor:
    """A word's vector is its axis; other texts get nearly independent axes."""
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


def painted_gaussians(along: int = TICKS) -> dict[str, Tensor]:
    """Gaussians on a grid over the wall, and one behind it that no camera sees."""
    ticks = (torch.arange(6 * along) + 0.5) / along - 3
    plane = torch.cartesian_prod(ticks, ticks)
    means = torch.cat([F.pad(plane, (0, 1)), torch.tensor([[0.0, 0.0, -50.0]])])
    count = len(means)
    return {
        "means": means,
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        "scales": torch.tensor([[0.42 / along, 0.42 / along, 0.001]]).log().repeat(count, 1),
        "opacities": torch.full((count, 1), 4.0),
        "features_dc": torch.zeros(count, 3),
        "features_rest": torch.zeros(count, 15, 3),
        "words": F.pad(word_at(plane), (0, 1)),
    }


def painted_splats(along: int = TICKS) -> Splats:
    """Gray for walls, brighter for every further word."""
    g = painted_gaussians(along)
    colors = (g["words"][:, None] / 3.0).expand(-1, 3)
    return Splats(
        g["means"], g["quats"], g["scales"].exp(), g["opacities"].sigmoid().squeeze(1), harmonics_of(colors)
    )


class Painted(Decoder):
    """Codes are the features themselves, decoded Gaussian by Gaussian."""

    name = "painted"
    per_gaussian = True

    def __init__(self, channels: int = CHANNELS) -> None:
        super().__init__(channels, 0)

    def forward(self, rendered):
        return rendered, None


def painted_codes(along: int = TICKS) -> Tensor:
    rows = features()[painted_gaussians(along)["words"]]
    rows[-1] = torch.nan  # nobody has seen it
    return rows


def photo(name: str, x: float, y: float, split="train", focal: int = 96, size: int = 96) -> ScenePhoto:
    view = torch.eye(4)
    view[:3, 3] = -torch.tensor([x, y, -DISTANCE])
    middle = size / 2
    lens = Lens(size, size, focal, focal, middle, middle)
    return ScenePhoto(name, split, camera_to_world(view).tolist(), lens)


def painted_file() -> SceneRecord:
    photos = [
        photo("left/0001.jpg", -1.5, -1),
        photo("right/0002.jpg", 1.5, 1.5),
        photo("all/0003.jpg", 0, 0, focal=70),
    ]
    photos.append(photo("held/0004.jpg", 0.5, 0.5, "eval"))
    return SceneRecord(photos, "clip", "0123", 1.0, torch.eye(4)[:3].tolist(), "nowhere")


def painted_scene(cache: Path | None = None, config: QueryConfig | None = None, **changes) -> Scene:
    parts = {
        "splats": painted_splats(),
        "file": painted_file(),
        "decoder": Painted(),
        "codes": painted_codes(),
    }
    parts |= {"encode_texts": encode_texts, "cache": cache, "config": config or QueryConfig()}
    return Scene(**{**parts, **changes})


def decoded(name: str, seed: int = 0) -> dict:
    """A decoder of this kind with random weights, and codes for the painted Gaussians."""
    torch.manual_seed(seed)
    decoder = make_decoder(DecoderConfig(name=name), SemanticFieldConfig(preset="short"), CHANNELS, 0)
    decoder.requires_grad_(False)
    count = len(painted_gaussians()["means"])
    if name == "lifting":
        codes = torch.randn(count, CHANNELS + 1).abs()
    elif (codes := decoder.initial_codes(count)) is None and name != "fmgs":
        codes = torch.randn(count, 3)
    gaussians = {"means": painted_splats().means}
    carried = decoder.carried(gaussians if codes is None else gaussians | {"codes": codes}).detach().clone()
    if name == "gathered":
        carried[7] = torch.nan
    return {"decoder": decoder, "codes": carried}


def painted_looks(seed: int = 0) -> AppearanceField:
    """A look of its own for every training photo."""
    generator = torch.Generator().manual_seed(seed)
    names = [photo.name for photo in painted_file().photos if photo.split == "train"]
    field = AppearanceField(AppearanceConfig(), names, torch.zeros(3), 5.0, generator=generator)
    with torch.no_grad():
        field.output.weight.normal_(0, 0.2, generator=generator)
        for photo in painted_file().photos[:3]:
            pose = photo.camera.view_matrix
            field.remember(photo.name, -pose[:3, :3].T @ pose[:3, 3], pose[2, :3])
    return field.eval().requires_grad_(False)
