"""Whether words find their pixels: relevancy maps of a photo against the scene's ground truth."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.scores import Maps, MapScorer, resize_map
from lang3dxl_ns.preparation.encoders import ImageTextEncoder
from lang3dxl_ns.query.relevancy import CANONICAL, relevancy, relevancy_of_codes


class LanguageScorer(MapScorer):
    """Relevancy maps of a scene's categories, of the 3D field and of its 2D teacher, by the same rules.

    The prompts are the categories' names. The teacher is the photo's own CLIP target: what the field learns
    from, had the photo been trained on.
    """

    def __init__(self, truth: GroundTruth, encoder: ImageTextEncoder) -> None:
        super().__init__(truth)
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

    def _named(self, maps: Float[Tensor, "q h w"]) -> Maps:
        return dict(zip(self.truth.categories, maps, strict=True))


def open_scorer(truth: GroundTruth, clip: str, device: torch.device | str) -> LanguageScorer:
    """The scorer for targets made with the CLIP of this name or folder."""
    from lang3dxl_ns.preparation.encoders import load_image_text_encoder

    return LanguageScorer(truth, load_image_text_encoder(clip, device))
