"""Whether words find their pixels: relevancy maps of a photo against the scene's ground truth."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.evaluation.holyscenes import GroundTruth, resize_map, score_maps
from lang3dxl_ns.preparation.encoders import ImageTextEncoder
from lang3dxl_ns.query.relevancy import CANONICAL, relevancy, relevancy_of_codes

Maps = dict[str, Float[Tensor, "h w"]]


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
        keep: Bool[Tensor, "H W"] | None = None,
    ) -> Maps:
        """Maps of rendered codes, at `size`; 0 outside `keep`, the foreground, where there is one."""
        maps = relevancy_of_codes(
            decode, codes, self._queries.to(codes.device), self._canonical.to(codes.device)
        )
        return self._finished(resize_map(maps, size), keep)

    def teacher_maps(
        self,
        target: Float[Tensor, "hd wd c"],
        size: tuple[int, int],
        keep: Bool[Tensor, "H W"] | None = None,
    ) -> Maps:
        """Maps of a CLIP target, whose features are interpolated to `size` first, as in Lang3D-XL."""
        features = resize_map(target.permute(2, 0, 1), size).permute(1, 2, 0)
        maps = relevancy(features, self._queries.to(features.device), self._canonical.to(features.device))
        return self._finished(maps, keep)

    def scores(self, photo: str, maps: Maps, prefix: str = "") -> dict[str, float]:
        """`{prefix}ap_{category}` of every category that the photo shows and has a mask of."""
        size = next(iter(maps.values())).shape
        return score_maps(maps, self.truth.masks(photo, (size[0], size[1])), prefix)

    def _finished(self, maps: Float[Tensor, "q h w"], keep: Bool[Tensor, "H W"] | None) -> Maps:
        if keep is not None:
            size = (maps.shape[1], maps.shape[2])
            maps = maps * (resize_map(keep[None].to(maps), size) >= 0.5)
        return dict(zip(self.truth.categories, maps, strict=True))


def open_scorer(truth: GroundTruth, clip: str, device: torch.device | str) -> LanguageScorer:
    """The scorer for targets made with the CLIP of this name or folder."""
    from lang3dxl_ns.preparation.encoders import load_image_text_encoder

    return LanguageScorer(truth, load_image_text_encoder(clip, device))
