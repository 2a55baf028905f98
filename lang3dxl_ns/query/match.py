"""Results of queries: views, matches, places, and their pictures. Arrays are NumPy's."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray as Array
from PIL import Image
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically
from lang3dxl_ns.query.heat_maps import PROMPT_COLORS, overlay, tinted, with_legend
from lang3dxl_ns.query.places import Box
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.rendering.render import Rendering
from lang3dxl_ns.scene.camera import Camera


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """A rendering of the scene, shared by several prompts."""

    rendering: Rendering
    """Its maps as tensors, on the scene's device."""
    name: str | None = None
    """The photo that was taken here; None for other cameras."""
    seconds: float = 0.0
    """Rendering time."""

    def __repr__(self) -> str:
        return f"View({_where(self)}, {self.camera.width} × {self.camera.height} pixels)"

    @property
    def camera(self) -> Camera:
        """Where the view is rendered from."""
        return self.rendering.camera

    @cached_property
    def pixels(self) -> UInt8[Array, "h w 3"]:
        """The colors as bytes."""
        return as_bytes(self.rendering.rgb)

    @cached_property
    def alpha(self) -> Float[Array, "h w"]:
        """Coverage, 0…1."""
        return self.rendering.alpha.cpu().numpy()

    @cached_property
    def depth(self) -> Float[Array, "h w"]:
        """Distance along the camera's axis, units of the model's frame; 0 where nothing is rendered."""
        return self.rendering.depth.cpu().numpy()

    def save(self, path: str | Path) -> Path:
        """Write the rendering as a picture."""
        return save_picture(self.pixels, path)


@dataclass(frozen=True, eq=False, repr=False)
class Match:
    """Match of a prompt in a view."""

    prompt: Prompt
    synonyms: list[str]
    """Synonyms searched along with the prompt."""
    doubt: float
    """Share of unrelated words that fit the scene as well: above 0.1 the scene hardly shows the prompt, or
    CLIP doesn't know it."""
    view: View
    relevancy: Float[Array, "h w"]
    """0…1; above 0.5 where the prompt beats all its competitors, 0 where nothing is rendered."""
    mask: Bool[Array, "h w"]
    """Pixels that matching Gaussians cover."""
    threshold: float
    """Relevancy above which Gaussians match."""
    seconds: float
    """For all prompts of the call, without rendering."""

    def __repr__(self) -> str:
        return (
            f"Match({self.prompt.text!r} in {_where(self.view)}: {self.score:.2f} at {self.peak}, "
            f"{self.area:.1%} of the view)"
        )

    @cached_property
    def peak(self) -> tuple[int, int]:
        """Column and row of the most relevant pixel."""
        row, column = np.unravel_index(int(self.relevancy.argmax()), self.relevancy.shape)
        return int(column), int(row)

    @property
    def score(self) -> float:
        """Relevancy at the peak."""
        return float(self.relevancy.max())

    @property
    def area(self) -> float:
        """Share of the view that matches."""
        return float(self.mask.mean())

    def overlay(self, opacity: float = 0.7, color_map: str = "turbo") -> UInt8[Array, "h w 3"]:
        """The heat map over the rendering. Raises UserError for an unknown matplotlib color map."""
        image, mask = self.view.rendering.rgb.cpu(), torch.from_numpy(self.mask)
        relevancy = torch.from_numpy(self.relevancy)
        return as_bytes(overlay(image, relevancy, mask, self.threshold, opacity, color_map))

    def save(self, path: str | Path) -> Path:
        """Write the overlay as a picture or, if the name ends in .npy, the relevancy (float32)."""
        path = Path(path)
        if path.suffix != ".npy":
            return save_picture(self.overlay(), path)
        content = io.BytesIO()
        np.save(content, self.relevancy.astype(np.float32))
        write_atomically(path, content.getvalue())
        return path


def together(matches: Sequence[Match]) -> UInt8[Array, "h+legend w 3"]:
    """Several prompts in one view: each in a color of its own, the strongest where they overlap, and a legend
    below. Raises UserError if there is none, or they are of different views."""
    if not matches or any(match.view.pixels.shape != matches[0].view.pixels.shape for match in matches):
        raise UserError("one picture shows the prompts of one view: pass the matches of a single query")
    maps = torch.stack([torch.from_numpy(match.relevancy) for match in matches])
    masks = torch.stack([torch.from_numpy(match.mask) for match in matches])
    lowest = min(match.threshold for match in matches)
    picture = as_bytes(tinted(matches[0].view.rendering.rgb.cpu(), maps, masks, lowest))
    return with_legend(picture, [match.prompt.text for match in matches], PROMPT_COLORS)


@dataclass(frozen=True, eq=False, repr=False)
class Viewpoint:
    """A training camera that shows a match."""

    name: str
    """Name of the photo."""
    camera: Camera
    area: float
    """Share of the view that matches."""
    score: float
    """Mean relevancy of the most relevant thousandth of the view."""
    rank: float
    """How well the view shows the match, 0…1 (`rank_views`)."""

    def __repr__(self) -> str:
        return f"Viewpoint({self.name!r}, rank {self.rank:.2f}, {self.area:.1%} of it matches)"


@dataclass(frozen=True, eq=False, repr=False)
class Found:
    """Match of a prompt in the scene."""

    prompt: Prompt
    views: list[Viewpoint]
    """Training views that show it, best first; empty if nothing matches."""
    box: Box | None
    """Around the strongest connected match; None if nothing matches."""
    relevancy: Float[Array, " n"]
    """Relevancy of every Gaussian, 0…1."""
    gaussians: Bool[Array, " n"]
    """Those that match: the selection that masks show in 2D."""
    doubt: float
    """As in `Match`."""
    threshold: float
    """Relevancy above which Gaussians match."""
    closest: list[Viewpoint] = field(default_factory=list)
    """The same ranking, also of views in which nothing matches."""

    def __repr__(self) -> str:
        best = f"best {self.views[0].name!r}" if self.views else "nothing matches"
        count = int(self.gaussians.sum())
        return f"Found({self.prompt.text!r}: {len(self.views)} views, {best}, {count:,} Gaussians)"


def as_bytes(image: Float[Tensor, "h w 3"]) -> UInt8[Array, "h w 3"]:
    """Colors in 0…1 as bytes."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def save_picture(pixels: UInt8[Array, "h w *c"], path: str | Path) -> Path:
    """Write a picture, in the format that its name says. Raises UserError for a format without pictures."""
    path, content = Path(path), io.BytesIO()
    form = Image.registered_extensions().get(path.suffix.lower())
    if form not in ("PNG", "JPEG", "WEBP", "TIFF", "BMP"):
        raise UserError(f"{path.name} names no kind of picture: end it in .png or .jpg")
    Image.fromarray(pixels).save(content, form, quality=92)
    write_atomically(path, content.getvalue())
    return path


def _where(view: View) -> str:
    return repr(view.name) if view.name else "a camera"
