"""Gathering, the adjoint of compositing: pixel values are averaged onto the Gaussians that they show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.common.image import resize

Composite = Callable[[nn.Parameter], Float[Tensor, "h w c"]]
"""Function that composites values of Gaussians, [n, c], in one view."""
MEMORY = 5e8
"""Bytes for the channels gathered at a time: values and gradients of both the Gaussians and the pixels."""


@dataclass(frozen=True)
class Pixels:
    """A view's values on the foreground (0 elsewhere), then two channels that are 1 on the foreground and
    outside it. They are computed a few channels at a time, because all channels of a large photo would take
    gigabytes."""

    maps: Sequence[Float[Tensor, "hd wd c"]]
    """Maps of any size, which are stretched over the view and concatenated along their channels."""
    foreground: Float[Tensor, "h w"]
    """1 on the foreground where all values are known, 0 elsewhere."""
    outside: Float[Tensor, "h w"]
    """1 outside the foreground, 0 elsewhere."""

    @classmethod
    def of(
        cls, maps: Sequence[Float[Tensor, "hd wd c"]], size: tuple[int, int], mask: Tensor | None = None
    ) -> Pixels:
        """Build the pixels of a view of this size (rows, columns) whose foreground is the mask [H, W] (None:
        everything), without the pixels where a map is not finite."""
        foreground = maps[0].new_ones(size)
        if mask is not None:
            foreground *= resize(mask[..., None].to(foreground), size)[..., 0] >= 0.5
        outside = 1 - foreground
        finite = [each.isfinite().all(-1, keepdim=True) for each in maps]
        for each in finite:
            foreground *= resize(each.to(foreground), size)[..., 0] > 1 - 1e-4
        return cls([torch.where(*pair, 0.0) for pair in zip(finite, maps, strict=True)], foreground, outside)

    def channels(self, start: int, stop: int) -> Float[Tensor, "h w part"]:
        """Return a range of the channels."""
        height, width = self.foreground.shape
        inside, outside = self.foreground[..., None], self.outside[..., None]
        found, first = [], 0
        for each in (*self.maps, inside, outside):
            part = each[..., max(start - first, 0) : max(stop - first, 0)]
            if part.shape[-1]:
                part = resize(part, (height, width))
                found.append(part if each is outside else part * inside)
            first += each.shape[-1]
        return torch.cat(found, dim=-1)


def gather(
    count: int, views: Iterable[tuple[Composite, Pixels]], width: int, like: Tensor
) -> tuple[Float[Tensor, "n c"], Float[Tensor, " n"]]:
    """Average the values of all pixels of all views onto the Gaussians; return means and masses.

    The mean is weighted by a Gaussian's contribution w to each pixel p, Σ w(g, p) F(p) / Σ w(g, p). Its mass
    is Σ w(g, p), in pixels. Gaussians that are never visible have mass and mean 0. So do those with more mass
    outside the foreground, or else the sky would take on values from the edges of towers. The work takes
    `MEMORY` bytes besides the result, which is on the CPU if it is larger.

    Args:
        count: number of Gaussians, n.
        views: for each view, a function that composites values of the Gaussians, and the pixels' values F.
        width: number of channels of the maps of F.
        like: tensor whose number type and device are used.
    """
    place = like.device if 4 * count * (width + 2) <= MEMORY else torch.device("cpu")
    sums = torch.zeros(count, width + 2, dtype=like.dtype, device=place)
    for composite, pixels in views:
        numbers = 2 * (count + pixels.foreground.numel())  # per channel
        channels = max(int(MEMORY / 4 / numbers), 1)
        for start in range(0, width + 2, channels):
            part = pixels.channels(start, start + channels).to(like)
            sums[:, start : start + channels] += filled_parts(composite, part, count).to(place)
    features, mass = sums[:, :width], torch.where(sums[:, -1] > sums[:, -2], 0, sums[:, -2])
    features /= torch.where(mass > 0, mass, torch.inf)[:, None]
    return features, mass


def filled_pixels(composite: Composite, weight: Float[Tensor, "h w"], count: int) -> Float[Tensor, " n"]:
    """Compute how many pixels every Gaussian fills in a view, with a weight per pixel."""
    return filled_parts(composite, weight[..., None], count)[:, 0]


def filled_parts(composite: Composite, weights: Float[Tensor, "h w k"], count: int) -> Float[Tensor, "n k"]:
    """Compute how many pixels every Gaussian fills in each of several parts of a view, weighted per pixel.
    Compositing is linear in the composited values, map(p) = Σ_g w(g, p) f(g), so these sums over pixels are
    its derivative in the direction of the weights, which one backward pass computes exactly."""
    with torch.enable_grad():
        probe = nn.Parameter(weights.new_zeros(count, weights.shape[-1]))
        (gradient,) = torch.autograd.grad(composite(probe), probe, weights)
    return gradient
