"""Results of queries: views, matches, places, and their pictures. Arrays are NumPy arrays."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray as Array
from PIL import Image
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded, write_atomically
from lang3dxl_ns.query.heat_maps import overlay, tinted, with_legend
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.query.trust import Trust
from lang3dxl_ns.query.view_ranking import Box, Viewpoint
from lang3dxl_ns.rendering import Rendering
from lang3dxl_ns.scene.camera import Camera


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """A rendering of the scene, which several prompts may share."""

    rendering: Rendering
    """The rendered maps as tensors, on the scene's device."""
    name: str | None = None
    """Name of the photo that was taken from here; None for other cameras."""
    seconds: float = 0.0
    """Time that the rendering took."""

    def __repr__(self) -> str:
        return f"View({_where(self)}, {self.camera.width} × {self.camera.height} pixels)"

    @property
    def camera(self) -> Camera:
        """The camera that the view is rendered from."""
        return self.rendering.camera

    @cached_property
    def pixels(self) -> UInt8[Array, "h w 3"]:
        """Colors of the view as bytes."""
        return as_bytes(self.rendering.rgb)

    @cached_property
    def alpha(self) -> Float[Array, "h w"]:
        """Coverage of every pixel, 0…1."""
        return self.rendering.alpha.cpu().numpy()

    @cached_property
    def depth(self) -> Float[Array, "h w"]:
        """Distance along the camera's axis in units of the model's frame; 0 where nothing is rendered."""
        return self.rendering.depth.cpu().numpy()

    def save(self, path: str | Path) -> Path:
        """Write the rendering as a picture and return its path."""
        return save_picture(self.pixels, path)


@dataclass(frozen=True, eq=False, repr=False)
class Match:
    """Match of a prompt in one view."""

    prompt: Prompt
    synonyms: list[str]
    """Synonyms searched along with the prompt."""
    doubt: float
    """Share of unrelated words that match the scene as well. Above 0.04 (0.1 for a taught word) the scene
    probably does not show the prompt, or CLIP does not know it."""
    trust: Trust
    """How far to believe the answer, in one word with its reason."""
    view: View
    relevancy: Float[Array, "h w"]
    """Relevancy of every pixel, 0…1: above 0.5 where the prompt beats all competitors; 0 where nothing is."""
    mask: Bool[Array, "h w"]
    """Pixels that matching Gaussians cover."""
    threshold: float
    """Relevancy above which Gaussians match."""
    seconds: float
    """Time for all prompts of the call, without rendering."""

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

    def overlay(self) -> UInt8[Array, "h w 3"]:
        """Draw the heat map over the rendering."""
        image, mask = self.view.rendering.rgb.cpu(), torch.from_numpy(self.mask)
        relevancy = torch.from_numpy(self.relevancy)
        return as_bytes(overlay(image, relevancy, mask, self.threshold))

    def save(self, path: str | Path) -> Path:
        """Write the overlay as a picture or, for a name that ends in .npy, the relevancy (float32)."""
        path = expanded(path)
        if path.suffix != ".npy":
            return save_picture(self.overlay(), path)
        content = io.BytesIO()
        np.save(content, self.relevancy.astype(np.float32))
        write_atomically(path, content.getvalue())
        return path


def together(matches: Sequence[Match]) -> UInt8[Array, "h+legend w 3"]:
    """Draw several prompts in one view, each in its own color, the strongest where they overlap, with a
    legend below. Raises UserError if there is no match, or the matches are of different views."""
    first = matches[0].view.camera if matches else None
    if first is None or not all(match.view.camera.same_as(first) for match in matches):
        raise UserError("one picture shows the prompts of one view: pass the matches of a single query")
    maps = torch.stack([torch.from_numpy(match.relevancy) for match in matches])
    masks = torch.stack([torch.from_numpy(match.mask) for match in matches])
    lowest = min(match.threshold for match in matches)
    picture = as_bytes(tinted(matches[0].view.rendering.rgb.cpu(), maps, masks, lowest))
    return with_legend(picture, [match.prompt.text for match in matches])


@dataclass(frozen=True, eq=False, repr=False)
class Found:
    """Match of a prompt in the whole scene."""

    prompt: Prompt
    views: list[Viewpoint]
    """Training views that show the match, best first; empty if nothing matches."""
    box: Box | None
    """Box around the strongest connected match; None if nothing matches."""
    relevancy: Float[Array, " n"]
    """Relevancy of every Gaussian, 0…1."""
    gaussians: Bool[Array, " n"]
    """Which Gaussians match; the masks of views show the same selection in 2D."""
    doubt: float
    """Share of unrelated words that match the scene as well, see `Match.doubt`."""
    trust: Trust
    """How far to believe the answer, in one word with its reason."""
    threshold: float
    """Relevancy above which Gaussians match."""

    def __repr__(self) -> str:
        best = f"best {self.views[0].name!r}" if self.views else "nothing matches"
        count = int(self.gaussians.sum())
        return f"Found({self.prompt.text!r}: {len(self.views)} views, {best}, {count:,} Gaussians)"


def as_bytes(image: Float[Tensor, "h w 3"]) -> UInt8[Array, "h w 3"]:
    """Convert colors in 0…1 to bytes."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def save_picture(pixels: UInt8[Array, "h w *c"], path: str | Path) -> Path:
    """Write a picture in the format that its name says. Raises UserError if that is no picture format."""
    path, content = expanded(path), io.BytesIO()
    form = Image.registered_extensions().get(path.suffix.lower())
    if form not in ("PNG", "JPEG", "WEBP", "TIFF", "BMP"):
        raise UserError(f"{path.name} has an unsupported image format: use .png or .jpg")
    Image.fromarray(pixels).save(content, form, quality=92)
    write_atomically(path, content.getvalue())
    return path


def _where(view: View) -> str:
    return repr(view.name) if view.name else "a camera"
