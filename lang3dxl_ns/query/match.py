"""Results of queries: views, matches, viewpoints, and their pictures."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
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
from lang3dxl_ns.scene.camera import Camera


@dataclass(repr=False)
class View:
    """A rendering, shared by several prompts. Tensors have no gradient."""

    camera: Camera
    image: Float[Tensor, "h w 3"]
    """Colors, 0…1."""
    carried: Float[Tensor, "h w d"] | None
    """Values that Gaussians carried for the prompts, composited over black; None without prompts."""
    alpha: Float[Tensor, "h w"]
    """Coverage, 0…1."""
    depth: Float[Tensor, "h w"]
    """Along the camera's axis, units of the model's frame."""
    seconds: float = 0.0
    """Rendering time."""
    counts: Bool[Tensor, "h w"] | None = None
    """Foreground of the photo at this view; None: everything."""
    name: str | None = None
    """Of the photo taken here; None for other cameras."""

    def __post_init__(self) -> None:
        self.image, self.alpha, self.depth = (t.detach() for t in (self.image, self.alpha, self.depth))
        self.carried = None if self.carried is None else self.carried.detach()

    def __repr__(self) -> str:
        return f"View({_where(self)}, {self.camera.width} × {self.camera.height} pixels)"

    @property
    def pixels(self) -> UInt8[Array, "h w 3"]:
        """The colors as bytes."""
        return as_bytes(self.image)

    def save(self, path: str | Path) -> Path:
        """Write the rendering as a picture."""
        return save_picture(self.pixels, path)


@dataclass(repr=False)
class Match:
    """Match of a prompt in a view."""

    prompt: Prompt
    synonyms: list[str]
    """Synonyms searched along with the prompt."""
    doubt: float
    """Share of unrelated words that fit the scene as well: above 0.1 the scene hardly shows the prompt, or
    CLIP doesn't know it."""
    view: View
    relevancy: Float[Tensor, "h w"]
    """0…1; above 0.5 where the prompt beats all its competitors, 0 where nothing is rendered."""
    mask: Bool[Tensor, "h w"]
    """Above the threshold."""
    peak: tuple[int, int]
    """Column and row of the most relevant pixel."""
    score: float
    """Relevancy there."""
    seconds: float
    """For all prompts of the call, without rendering."""
    threshold: float = 0.5
    """Relevancy above which a pixel matches."""

    def __post_init__(self) -> None:
        self.relevancy = self.relevancy.detach()

    def __repr__(self) -> str:
        return (
            f"Match({self.prompt.text!r} in {_where(self.view)}: {self.score:.2f} at {self.peak}, "
            f"{self.area:.1%} of the view)"
        )

    @property
    def area(self) -> float:
        """Share of the view that matches."""
        return float(self.mask.float().mean())

    def overlay(self, opacity: float = 0.7, color_map: str = "turbo") -> UInt8[Array, "h w 3"]:
        """The heat map over the rendering. Raises UserError for an unknown matplotlib color map."""
        return as_bytes(overlay(self.view.image, self.relevancy, self.threshold, opacity, color_map))

    def save(self, path: str | Path) -> Path:
        """Write the overlay as a picture or, if the name ends in .npy, the relevancy (float32)."""
        path = Path(path)
        if path.suffix != ".npy":
            return save_picture(self.overlay(), path)
        content = io.BytesIO()
        np.save(content, self.relevancy.cpu().numpy().astype(np.float32))
        write_atomically(path, content.getvalue())
        return path


def together(matches: Sequence[Match], opacity: float = 0.7) -> UInt8[Array, "h+legend w 3"]:
    """Several prompts in one view: each in a color of its own, the strongest where they overlap, and a legend
    below. Raises UserError if there is none, or they are of different views."""
    if not matches or any(match.view.image.shape != matches[0].view.image.shape for match in matches):
        raise UserError("one picture shows the prompts of one view: pass the matches of a single query")
    maps = torch.stack([match.relevancy for match in matches])
    thresholds = [match.threshold for match in matches]
    picture = as_bytes(tinted(matches[0].view.image, maps, thresholds, opacity))
    return with_legend(picture, [match.prompt.text for match in matches], PROMPT_COLORS)


@dataclass(repr=False)
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


@dataclass(repr=False)
class Found:
    """Matches of a prompt in the scene."""

    prompt: Prompt
    viewpoints: list[Viewpoint]
    """Best first; empty if nothing matches."""
    box: Box | None
    """Around the strongest connected match; None if nothing matches."""
    doubt: float
    """As in `Match`."""
    threshold: float
    """Relevancy above which Gaussians match."""
    closest: list[Viewpoint] = field(default_factory=list)
    """The same ranking, also of views in which nothing matches."""

    def __repr__(self) -> str:
        best = f"best {self.viewpoints[0].name!r}" if self.viewpoints else "nothing matches"
        return f"Found({self.prompt.text!r}: {len(self.viewpoints)} viewpoints, {best})"


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
