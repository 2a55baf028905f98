"""Whether words find their pixels: relevancy maps of a photo against the scene's ground truth."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter
from torch import Tensor

from lang3dxl_ns.evaluation.holyscenes import GroundTruth, resize_map, score_maps
from lang3dxl_ns.preparation.encoders import ImageTextEncoder
from lang3dxl_ns.query.relevancy import CANONICAL, relevancy, relevancy_of_codes

Maps = dict[str, Float[Tensor, "h w"]]
BLUR = 2.5
"""Pixels at half the photo's size, by which the publication blurs relevancy maps."""


class LanguageScorer:
    """Relevancy maps of a scene's categories, of the 3D field and of its 2D teacher, by the same rules.

    The prompts are the categories' names. The teacher is the photo's own CLIP target: what the field learns
    from, had the photo been trained on.
    """

    def __init__(self, truth: GroundTruth, encoder: ImageTextEncoder) -> None:
        self.truth = truth
        self._queries = encoder.encode_texts(truth.categories)
        self._canonical = encoder.encode_texts(list(CANONICAL))

    def field_maps(
        self,
        decode: Callable[[Float[Tensor, "n code"]], Float[Tensor, "n c"]],
        codes: Float[Tensor, "H W code"],
        size: tuple[int, int],
    ) -> Maps:
        """Maps of rendered codes, at `size`."""
        maps = relevancy_of_codes(
            decode, codes, self._queries.to(codes.device), self._canonical.to(codes.device)
        )
        return self._named(resize_map(maps, size))

    def teacher_maps(self, target: Float[Tensor, "hd wd c"], size: tuple[int, int]) -> Maps:
        """Maps of a CLIP target, whose features are interpolated to `size` first, as in Lang3D-XL."""
        features = resize_map(target.permute(2, 0, 1), size).permute(1, 2, 0)
        maps = relevancy(features, self._queries.to(features.device), self._canonical.to(features.device))
        return self._named(maps)

    def scores(self, photo: str, maps: Maps, prefix: str = "") -> dict[str, float]:
        """`{prefix}ap_{category}` of every category that the photo shows and has a mask of."""
        size = next(iter(maps.values())).shape
        return score_maps(maps, self.truth.masks(photo, (size[0], size[1])), prefix)

    def _named(self, maps: Float[Tensor, "q h w"]) -> Maps:
        return dict(zip(self.truth.categories, maps, strict=True))


def blurred(maps: Maps, sigma: float = BLUR) -> Maps:
    """Every map under a Gaussian of `sigma` pixels."""
    return {
        name: torch.from_numpy(gaussian_filter(scores.cpu().numpy(), sigma)).to(scores.device)
        for name, scores in maps.items()
    }


def inside(maps: Maps, keep: Bool[Tensor, "H W"] | None) -> Maps:
    """Every map, 0 outside the foreground `keep`, where there is one."""
    if keep is None:
        return maps
    size = next(iter(maps.values())).shape
    there = resize_map(keep[None].float(), (size[0], size[1]))[0] >= 0.5
    return {name: scores * there for name, scores in maps.items()}


def open_scorer(truth: GroundTruth, clip: str, device: torch.device | str) -> LanguageScorer:
    """The scorer for targets made with the CLIP of this name or folder."""
    from lang3dxl_ns.preparation.encoders import load_image_text_encoder

    return LanguageScorer(truth, load_image_text_encoder(clip, device))
