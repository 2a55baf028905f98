"""Gathering, the adjoint of compositing: pixel values averaged onto the Gaussians that they show."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn

Composite = Callable[[nn.Parameter], Float[Tensor, "h w c"]]
"""Composites values of Gaussians, [n, c], in one view."""


def gather(
    count: int, views: Iterable[tuple[Composite, Float[Tensor, "h w c+1"]]], width: int, like: Tensor
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
    """
    sums = like.new_zeros(count, width + 1)
    for composite, pixels in views:
        with torch.enable_grad():
            probe = nn.Parameter(like.new_zeros(count, width + 1))
            (gradient,) = torch.autograd.grad(composite(probe), probe, pixels.to(like))
        sums += gradient
    features, mass = sums[:, :-1], sums[:, -1]
    seen = mass > 0
    return torch.where(seen[:, None], features / torch.where(seen, mass, 1.0)[:, None], 0.0), mass


def filled_pixels(composite: Composite, weight: Float[Tensor, "h w"], count: int) -> Float[Tensor, " n"]:
    """Pixels that every Gaussian fills in a view, with a weight per pixel."""
    with torch.enable_grad():
        probe = nn.Parameter(weight.new_zeros(count, 1))
        (gradient,) = torch.autograd.grad(composite(probe), probe, weight[..., None])
    return gradient[:, 0]
