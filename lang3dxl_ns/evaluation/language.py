"""Language scores: relevancy maps of a photo against the scene's ground truth."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.scores import Maps, MapScorer, resize_map
from lang3dxl_ns.preparation.encoders import load_image_text_encoder
from lang3dxl_ns.query.relevancy import CANONICAL, TEMPERATURE, calibrated
from lang3dxl_ns.query.text import EncodeTexts, Prompt, TextConfig, TextEncoder


class LanguageScorer(MapScorer):
    """Scorer of relevancy maps for a scene's categories, whose names are the prompts. It treats the 3D field
    and its 2D teacher, the photo's own CLIP target, alike."""

    def __init__(self, truth: GroundTruth, encode_texts: EncodeTexts) -> None:
        super().__init__(truth)
        text = TextEncoder(encode_texts)
        self.queries = text.plain_queries(truth.categories)
        """Queries of the categories, in their order."""
        self.yardstick = text.yardstick
        """Words that calibrate relevancies, from `TextEncoder.yardstick`."""
        published = TextEncoder(encode_texts, TextConfig(combine="joined", negatives=CANONICAL))
        self.published_queries = published.queries([Prompt(category) for category in truth.categories])
        """Queries as published: a specialist word joined with common ones, against canonical phrases."""

    def named(self, maps: Float[Tensor, "q H W"], size: tuple[int, int]) -> Maps:
        """Return the categories' maps by name, resized to `size`."""
        return dict(zip(self.truth.categories, resize_map(maps, size), strict=True))

    def teacher_maps(self, target: Float[Tensor, "hd wd c"], size: tuple[int, int]) -> Maps:
        """Compute maps of a CLIP target, whose features are first interpolated to `size`, as in Lang3D-XL."""
        features = resize_map(target.permute(2, 0, 1), size).permute(1, 2, 0)
        queries, words = self.queries.to(features.device), self.yardstick.to(features.device)
        temperature = calibrated(TEMPERATURE, words.cosines(target.flatten(0, 1).float()))
        return self.named(queries.relevancy_of_cosines(queries.cosines(features), temperature), size)


def open_scorer(truth: GroundTruth, clip: str, device: torch.device | str) -> LanguageScorer:
    """Open the scorer for targets made with this CLIP (name or folder)."""
    return LanguageScorer(truth, load_image_text_encoder(clip, device).encode_texts)
