"""Gathering, the adjoint of compositing: pixel values averaged onto the Gaussians that they show."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

Composite = Callable[[nn.Parameter], Float[Tensor, "h w c"]]
"""Composites values of Gaussians, [n, c], in one view."""


MEMORY = 1e9
"""Bytes for the channels gathered at a time: of the Gaussians and of the pixels, values and gradients."""


def gather(
    count: int,
    views: Iterable[tuple[Composite, Float[Tensor, "h w c+1"]]],
    width: int,
    like: Tensor,
    memory: float | None = None,
) -> tuple[Float[Tensor, "n c"], Float[Tensor, " n"]]:
    """Mean over all pixels p of all views, weighted by a Gaussian's contribution, Σ w(g, p) F(p) / Σ w(g, p),
    and its mass Σ w(g, p) in pixels. Gaussians never visible have mass and mean 0.

    Compositing is linear in the values composited, map(p) = Σ_g w(g, p) f(g), so the sums are its derivative
    in the direction of F: one backward pass per view, exact.

    Args:
        count: number of Gaussians, n.
        views: for each, a function that composites values of the Gaussians, and the pixels' values F, whose
            last channel is 1 on the foreground; all channels are 0 elsewhere.
        width: channels of F without the last one.
        like: gives number type and device.
        memory: bytes to work in (default `MEMORY`), beside the result, which is on the CPU if it is larger.
    """
    memory = memory or MEMORY
    place = like.device if 4 * count * (width + 1) <= memory else torch.device("cpu")
    sums = torch.zeros(count, width + 1, dtype=like.dtype, device=place)
    for composite, pixels in views:
        numbers = 2 * (count + pixels[..., 0].numel())  # per channel
        channels = max(int(memory / 4 / numbers), 1)
        for start in range(0, width + 1, channels):
            part = pixels[..., start : start + channels].to(like)
            with torch.enable_grad():
                probe = nn.Parameter(like.new_zeros(count, part.shape[-1]))
                (gradient,) = torch.autograd.grad(composite(probe), probe, part)
            sums[:, start : start + channels] += gradient.to(place)
    features, mass = sums[:, :-1], sums[:, -1]
    seen = mass > 0
    return torch.where(seen[:, None], features / torch.where(seen, mass, 1.0)[:, None], 0.0), mass


def lift_masks(
    count: int, views: Iterable[tuple[Composite, Bool[Tensor, "h w"]]], like: Tensor
) -> Float[Tensor, " n"]:
    """Votes of masks in photos about Gaussians: the share of each Gaussian's visible pixels that lie in the
    masks, 0…1; 0 for Gaussians never visible. Above 0.5 the majority says that it belongs to what was
    segmented.

    Args:
        count: number of Gaussians, n.
        views: for each, a function that composites values of the Gaussians, and the mask.
        like: gives number type and device.
    """
    pixels = (
        (composite, torch.stack([mask.to(like), torch.ones_like(mask).to(like)], -1))
        for composite, mask in views
    )
    return gather(count, pixels, 1, like)[0][:, 0]


def filled_pixels(composite: Composite, weight: Float[Tensor, "h w"], count: int) -> Float[Tensor, " n"]:
    """Pixels that every Gaussian fills in a view, with a weight per pixel."""
    with torch.enable_grad():
        probe = nn.Parameter(weight.new_zeros(count, 1))
        (gradient,) = torch.autograd.grad(composite(probe), probe, weight[..., None])
    return gradient[:, 0]
