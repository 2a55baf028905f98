"""Training-free lifting: a Gaussian's feature is the mean of the pixels' that it contributes to."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.components.encoder import SemanticEncoder
from lang3dxl_ns.components.losses import resize

_LEAST_COVERAGE = 1e-4


class LiftedFeatures(SemanticEncoder):
    """Nothing is carried in training. Afterwards Gaussians carry the lifted features and a 1, whose rendering
    is the coverage: a map is the mean of what the visible Gaussians carry, whatever part of a pixel they
    cover."""

    needs_lifting = True

    def initial_codes(self, count: int, generator: torch.Generator | None = None) -> None:
        return None

    def carried(self, gaussians: Mapping[str, Tensor]) -> Float[Tensor, "n d"] | None:
        return gaussians.get("codes")

    def forward(
        self, rendered: Float[Tensor, "*batch d"]
    ) -> tuple[Float[Tensor, "*batch clip"], Float[Tensor, "*batch dense"] | None]:
        return self._split(rendered[..., :-1] / rendered[..., -1:].clamp_min(_LEAST_COVERAGE))

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {}


def lift(
    count: int,
    views: Iterable[tuple[Callable[[nn.Parameter], Float[Tensor, "h w d"]], Float[Tensor, "h w d"]]],
    width: int,
    like: Tensor,
) -> Float[Tensor, "n d"]:
    """The contribution-weighted mean over all pixels p of all views, Σ w(g, p) F(p) / Σ w(g, p), of every
    Gaussian g, and 0 for those that show nowhere.

    Compositing is linear in what is composited, map(p) = Σ_g w(g, p) f(g), so the sums are its derivative in
    the direction of F: one backward per view, exact.

    Args:
        count: of the Gaussians, n.
        views: for each a function that composites what Gaussians carry, and what its pixels show, F, the
            last channel 1 where the pixel counts and all 0 where it doesn't.
        width: d, that channel counted.
        like: gives number type and device.
    """
    sums = like.new_zeros(count, width)
    for composite, pixels in views:
        probe = nn.Parameter(like.new_zeros(count, width))
        (gradient,) = torch.autograd.grad(composite(probe), probe, pixels.to(like))
        sums += gradient
    weight = sums[:, -1:]
    return torch.where(weight > 0, sums / torch.where(weight > 0, weight, 1.0), 0.0)


def pixel_features(
    clip: Float[Tensor, "hd wd c"],
    dense: Float[Tensor, "t t d"] | None,
    mask: Tensor | None,
    size: tuple[int, int],
) -> Float[Tensor, "h w out"]:
    """A photo's targets at every pixel (bilinear), and a last channel of 1; all 0 off the mask [H, W]."""
    maps = [resize(target, size) for target in (clip, dense) if target is not None]
    pixels = torch.cat([*maps, torch.ones_like(maps[0][..., :1])], dim=-1)
    if mask is None:
        return pixels
    return pixels * (resize(mask[..., None].to(pixels), size) >= 0.5)
