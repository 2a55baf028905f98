"""Zero-shot score of a CLIP on unseen landmarks: crop pyramid, relevancy, average precision.

It measures the targets that the 3D field learns from: an upper bound in 2D.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from numpy import ndarray as Array
from torch import Tensor

from lab.clip_training.captions import CLASS, UNLABELED
from lab.clip_training.views import COLOR, ELEMENT, PART
from lab.landmark.labels import CATEGORIES, SMALLEST_POSITIVE, category_masks
from lang3dxl_ns.evaluation.scores import average_precision
from lang3dxl_ns.preparation.encoders import ImageTextEncoder
from lang3dxl_ns.preparation.pyramid import build_clip_target
from lang3dxl_ns.query.relevancy import CANONICAL, Queries

CROP_SIDES = (32, 48, 68)
"""Pixels of a 480×360 view; chosen on validation landmarks."""


def teacher_precision(
    encoder: ImageTextEncoder, view: UInt8[Array, "6 h w"], sides: Sequence[int] = CROP_SIDES
) -> dict[str, float]:
    """Average precision on one view for each category it shows, with the bare category names as prompts.

    The pyramid is that of the preparation; its features are read at half the photo's size, as in Lang3D-XL.
    The truth of towers includes their windows.
    """
    queries, canonical = encoder.encode_texts(list(CATEGORIES)), encoder.encode_texts(list(CANONICAL))
    maps = _relevancy_maps(encoder, view, sides, queries, canonical)
    masks = category_masks(view[PART, 1::2, 1::2], view[ELEMENT, 1::2, 1::2])
    scores = {}
    for name, score in zip(CATEGORIES, maps, strict=True):
        precision = average_precision(score, masks[name])
        if precision is not None and masks[name].mean() >= SMALLEST_POSITIVE:
            scores[name] = precision
    return scores


def _relevancy_maps(
    encoder: ImageTextEncoder,
    view: UInt8[Array, "6 h w"],
    sides: Sequence[int],
    queries: Float[Tensor, "q c"],
    canonical: Float[Tensor, "p c"],
) -> Float[Array, "q y x"]:
    """Relevancy at half the view's size."""
    photo = torch.from_numpy(view[COLOR].transpose(1, 2, 0).astype(np.float32) / 255)
    target = build_clip_target(
        encoder.in_known_light(photo), sides, encoder.encode_images, encoder.crop_size, 256
    )
    half = (view.shape[1] // 2, view.shape[2] // 2)
    features = F.interpolate(target.features.permute(2, 0, 1)[None], half, mode="bilinear")[0]
    prompts = Queries.of(queries[:, None].unbind(), canonical)
    return prompts.relevancy_of_cosines(prompts.cosines(features.permute(1, 2, 0))).numpy()


@dataclass
class TeacherScore:
    """Average precision per category over the views that show it, and the mean over the categories."""

    precision: dict[str, float]

    @classmethod
    def of(cls, found: dict[str, list[float]]) -> TeacherScore:
        """The score from the views' precisions; categories that none of them shows are left out."""
        return cls({name: float(np.mean(values)) for name, values in found.items() if values})

    @property
    def mean(self) -> float:
        return float(np.mean(list(self.precision.values())))

    def __str__(self) -> str:
        columns = (f"{name} {value:.3f}" for name, value in self.precision.items())
        return f"mAP {self.mean:.3f} ({', '.join(columns)})"


def score_teacher(
    encoder: ImageTextEncoder, views: Sequence[UInt8[Array, "6 h w"]], sides: Sequence[int] = CROP_SIDES
) -> TeacherScore:
    """The encoder's score on views; categories that none of them shows are left out."""
    found: dict[str, list[float]] = {name: [] for name in CATEGORIES}
    for view in views:
        for name, precision in teacher_precision(encoder, view, sides).items():
            found[name].append(precision)
    return TeacherScore.of(found)


PHOTO_WORDS = {"window": "window", "vegetation": "tree", "sky": "sky", "car": "car", "road": "road"}
"""Words for scoring labeled photos, and the classes that they name."""


def score_photos(
    encoder: ImageTextEncoder, views: Sequence[UInt8[Array, "6 h w"]], sides: Sequence[int] = CROP_SIDES
) -> TeacherScore:
    """Score on labeled photos; unlabeled pixels don't count."""
    words = list(PHOTO_WORDS)
    queries, canonical = encoder.encode_texts(words), encoder.encode_texts(list(CANONICAL))
    found: dict[str, list[float]] = {word: [] for word in words}
    for view in views:
        labels = view[PART, 1::2, 1::2]
        for word, score in zip(words, _relevancy_maps(encoder, view, sides, queries, canonical), strict=True):
            mask, known = labels == CLASS[PHOTO_WORDS[word]], labels != UNLABELED
            precision = average_precision(score[known], mask[known])
            if precision is not None and mask.mean() >= SMALLEST_POSITIVE:
                found[word].append(precision)
    return TeacherScore.of(found)
