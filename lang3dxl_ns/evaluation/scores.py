"""Scores of relevancy maps against masks and boxes: AP, IoU, F1, localization, LangSplat's measures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from scipy.ndimage import gaussian_filter, uniform_filter
from torch import Tensor

from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.layouts import Truth
from lang3dxl_ns.preparation.encoders import load_image_text_encoder
from lang3dxl_ns.query.relevancy import CANONICAL, TEMPERATURE, calibrated
from lang3dxl_ns.query.text import EncodeTexts, Prompt, TextConfig, TextEncoder

Maps = dict[str, Float[Tensor, "h w"]]
"""Relevancy maps by category, 0…1, above 0.5 at matches."""
BLUR = 2.5
"""Blur of relevancy maps in Lang3D-XL, in pixels at half the photo's size."""
THRESHOLD = 0.5
"""Relevancy above which a pixel counts as a match."""
SMOOTHING = 30
"""Side of LangSplat's mean filter, pixels."""
SMOOTH_THRESHOLD = 0.4
"""Threshold of LangSplat's masks, the same for all photos."""
_VOTERS = 7
_CHANNELS = 64
"""Number of feature channels that are interpolated at a time."""


def average_precision(score: Float[Array, "*shape"], truth: Bool[Array, "*shape"]) -> float | None:
    """Compute AP = Σ (R_n − R_{n−1}) P_n over all pixels as scikit-learn does, with equal scores as one step;
    None without a positive. Raises ValueError on NaN or on shapes that differ."""
    from sklearn.metrics import average_precision_score

    if score.shape != truth.shape:
        raise ValueError(f"the score map has shape {score.shape}, the truth {truth.shape}")
    return float(average_precision_score(truth.ravel(), score.ravel())) if truth.any() else None


def score_map(score: Float[Array, "h w"], truth: Truth, smooth: bool = False) -> dict[str, float]:
    """Compute all measures of a map; empty if the object is not in the photo, where AP is undefined. They are
    average precision (`ap`), those of `overlap` for the pixels above 0.5, and `located` (LERF's accuracy).
    `smooth` adds `smooth_located` and the `overlap` of LangSplat's mask, `smooth_iou` etc."""
    precision = average_precision(score, truth.mask)
    if precision is None:
        return {}
    scores = {"ap": precision, **overlap(score > THRESHOLD, truth.mask), "located": located(score, truth)}
    if smooth:
        mean = uniform_filter(score.astype(np.float64), SMOOTHING, mode="mirror")
        scores["smooth_located"] = located(mean, truth)
        smoothed = overlap(smooth_mask(score, mean), truth.mask)
        scores |= {f"smooth_{name}": smoothed[name] for name in ("iou", "pixel_accuracy", "precision")}
    return scores


def overlap(found: Bool[Array, "h w"], truth: Bool[Array, "h w"]) -> dict[str, float]:
    """Compute intersection over union, F1, balanced accuracy (the recall if the truth has no negative), pixel
    accuracy and precision (0 if there is no match) of a mask. The truth must have a positive."""
    both, missed = np.count_nonzero(found & truth), np.count_nonzero(truth & ~found)
    extra = np.count_nonzero(found & ~truth)
    negatives = truth.size - both - missed
    recalls = [both / (both + missed)] + ([1 - extra / negatives] if negatives else [])
    return {
        "iou": both / (both + missed + extra),
        "f1": 2 * both / (2 * both + missed + extra),
        "balanced_accuracy": sum(recalls) / len(recalls),
        "pixel_accuracy": 1 - (missed + extra) / truth.size,
        "precision": both / max(both + extra, 1),
    }


def located(score: Float[Array, "h w"], truth: Truth) -> float:
    """Return 1 if one of the highest pixels lies in a box, or on the mask if there are no boxes, else 0. A
    constant map locates nothing."""
    highest = score == score.max()
    if highest.all():
        return 0.0
    if truth.boxes is None:
        return float(truth.mask[highest].any())
    rows, columns = np.nonzero(highest)
    left, top, right, bottom = truth.boxes[:, :, None].transpose(1, 0, 2)
    return float(((left <= columns) & (columns <= right) & (top <= rows) & (rows <= bottom)).any())


def smooth_mask(score: Float[Array, "h w"], mean: Float[Array, "h w"]) -> Bool[Array, "h w"]:
    """Compute LangSplat's mask: the mean of the map and its mean-filtered copy, stretched to −1…1, above 0.4
    by majority of the neighbors (Qin et al. 2024). The threshold is fixed, not chosen by the truth."""
    mixed = (score + mean) / 2
    lowest, highest = mixed.min(), mixed.max()
    stretched = 2 * (mixed - lowest) / max(highest - lowest, 1e-9) - 1
    above = (stretched > SMOOTH_THRESHOLD).astype(np.float64)
    return uniform_filter(above, _VOTERS, mode="mirror") > 0.5


def strongest_level(levels: Float[Array, "l h w"]) -> Float[Array, "h w"]:
    """Choose the map with the highest smoothed peak among maps at several levels (LangSplat has three)."""
    peaks = [uniform_filter(level.astype(np.float64), SMOOTHING, mode="mirror").max() for level in levels]
    return levels[int(np.argmax(peaks))]


def resize_map(image: Float[Tensor, "n H W"], size: tuple[int, int]) -> Float[Tensor, "n h w"]:
    """Resize maps or feature channels to (height, width), bilinearly."""
    if tuple(image.shape[-2:]) == size:
        return image
    return F.interpolate(image[None].float(), size, mode="bilinear", align_corners=False)[0]


def map_size(maps: Maps) -> tuple[int, int]:
    """Return height and width of a photo's maps."""
    height, width = next(iter(maps.values())).shape
    return height, width


def blurred(maps: Maps) -> Maps:
    """Blur every map by a Gaussian of `BLUR` pixels."""
    return _each(maps, lambda score: gaussian_filter(score, BLUR))


def inside(maps: Maps, keep: Bool[Tensor, "H W"] | None) -> Maps:
    """Set every map to 0 outside the foreground `keep`, if given."""
    if keep is None:
        return maps
    there = resize_map(keep[None].float(), map_size(maps))[0] >= 0.5
    return {name: scores * there for name, scores in maps.items()}


def as_published(maps: Maps) -> Maps:
    """Process every (masked) map as Lang3D-XL does: 0 up to 0.5, the rest stretched to 0…1 by the photo's
    maximum, then blurred. So all rejected pixels tie, but for the blur."""

    def process(score: Float[Array, "h w"]) -> Float[Array, "h w"]:
        floor = max(float(score.min()), THRESHOLD)
        stretched = (score - floor).clip(0) / max(float(score.max()) - floor, 1e-9)
        return gaussian_filter(stretched, BLUR, truncate=8)

    return _each(maps, process)


def softened(maps: Maps, temperature: float) -> Maps:
    """Convert relevancy maps of this temperature to temperature 1, which the publication uses."""
    if temperature == 1:
        return maps
    return {
        name: torch.sigmoid(torch.logit(scores.double(), eps=1e-9) / temperature).to(scores.dtype)
        for name, scores in maps.items()
    }


def _each(maps: Maps, change: Callable[[Float[Array, "h w"]], Float[Array, "h w"]]) -> Maps:
    return {k: torch.from_numpy(change(m.cpu().numpy())).to(m.device) for k, m in maps.items()}


def score_maps(
    maps: Mapping[str, Float[Tensor, "h w"]],
    truths: Mapping[str, Truth],
    prefix: str = "",
    smooth: bool = False,
) -> dict[str, float]:
    """Compute `{prefix}{measure}_{category}` for every category that has a truth and is in the photo."""
    scores = {}
    for category, truth in truths.items():
        for measure, value in score_map(maps[category].detach().cpu().numpy(), truth, smooth).items():
            scores[f"{prefix}{measure}_{category}"] = value
    return scores


def bounds(labels: Maps, truths: Mapping[str, Truth]) -> dict[str, float]:
    """Compute average precision by chance and at best, for every category in the photo.
    `chance_ap_{category}` is that of a map without information, the share of positives. `limit_ap_{category}`
    is that of `labels`, the exact labels after lifting and rendering (`label_limit`)."""
    found: dict[str, float] = {}
    for category, truth in truths.items():
        best = average_precision(labels[category].cpu().numpy(), truth.mask)
        if best is not None:
            found[f"chance_ap_{category}"] = float(truth.mask.mean())
            found[f"limit_ap_{category}"] = best
    return found


class MapScorer:
    """Scorer of maps against a scene's ground truth, for runs and for predictions of other programs alike."""

    def __init__(self, truth: GroundTruth) -> None:
        self.truth = truth
        self.without: dict[str, set[str]] = {}
        """Photos left out because their label of a category is empty, by category."""
        self._scored: set[str] = set()

    @property
    def smooths(self) -> bool:
        """Whether the measures smooth maps themselves, so that there is only one variant."""
        return self.truth.layout == "lerf_ovs"

    def variants(
        self,
        maps: Maps,
        keep: Bool[Tensor, "H W"] | None = None,
        temperature: float = 1.0,
        of_published_prompts: Maps | None = None,
    ) -> dict[str, Maps]:
        """Return the maps to score, by the prefix of their figures.

        For masks, "" is blurred, "raw_" unprocessed, and "authors_" processed by `as_published`. For
        LERF-OVS, whose measures include smoothing, there is only "", unprocessed. Maps are set to 0 outside
        `keep`, before and after the blur. "authors_" is made from `of_published_prompts`, or from `maps` if
        that is None.
        """
        raw = inside(maps, keep)
        if self.smooths:
            return {"": raw}
        published = softened(of_published_prompts or maps, temperature)
        authors = as_published(inside(published, keep))
        return {"": inside(blurred(raw), keep), "raw_": raw, "authors_": authors}

    def scores(
        self, photo: str, variants: Mapping[str, Maps], truths: Mapping[str, Truth] | None = None
    ) -> dict[str, float]:
        """Compute `{prefix}{measure}_{category}` of maps by prefix, for every labeled category in the photo.
        `truths` are the photo's labels at the size of the maps; by default they are read from the files."""
        if truths is None:
            truths = self.truth.truths(photo, map_size(next(iter(variants.values()))))
        for category, truth in truths.items():
            if truth.mask.any():
                self._scored.add(category)
            else:
                self.without.setdefault(category, set()).add(photo)
        found: dict[str, float] = {}
        for prefix, maps in variants.items():
            found |= score_maps(maps, truths, prefix, self.smooths)
        return found

    def protocol(self, mask: str, of: str = "photo's") -> dict[str, Any]:
        """Describe for a report what the figures mean. `mask` says how the foreground was treated, and `of`
        whose size was halved for masks."""
        truth = self.truth
        size = "the labels'" if self.smooths else f"half the {of}"
        return {
            "ground_truth": str(truth.folder),
            "layout": truth.layout,
            "prompts": truth.categories,
            "scored_at": f"{size} size",
            "foreground": mask,
            "prompts_without_photos": [c for c in truth.categories if c not in self._scored],
            "photos_without_positives": {category: len(photos) for category, photos in self.without.items()},
        }


class LanguageScorer(MapScorer):
    """Scorer of relevancy maps for a scene's categories, whose names are the prompts. It treats the 3D field
    and its 2D teacher, the photo's own CLIP target, alike."""

    def __init__(self, truth: GroundTruth, encode_texts: EncodeTexts) -> None:
        super().__init__(truth)
        self.encode_texts = encode_texts
        text = TextEncoder(encode_texts)
        self.queries = text.plain_queries(truth.categories)
        """Queries of the categories, in their order."""
        self.yardstick = text.yardstick
        """Words that calibrate the relevancies of targets, from `TextEncoder.yardstick`."""
        published = TextEncoder(encode_texts, TextConfig(combine="joined", negatives=CANONICAL))
        self.published_queries = published.queries([Prompt(category) for category in truth.categories])
        """Queries as published: a specialist word joined with common ones, against canonical phrases."""

    def named(self, maps: Float[Tensor, "q H W"], size: tuple[int, int]) -> Maps:
        """Return the categories' maps by name, resized to `size`."""
        return dict(zip(self.truth.categories, resize_map(maps, size), strict=True))

    def teacher_maps(self, target: Float[Tensor, "hd wd c"], size: tuple[int, int]) -> Maps:
        """Compute maps of a CLIP target, whose features are first interpolated to `size`, as in Lang3D-XL.
        A few channels at a time are: all of a large photo's would take gigabytes."""
        queries, words = self.queries.to(target.device), self.yardstick.to(target.device)
        dots = queries.vectors.new_zeros(*size, len(queries.vectors))
        squares = queries.vectors.new_zeros(size)
        channels = zip(target.split(_CHANNELS, -1), queries.vectors.split(_CHANNELS, -1), strict=True)
        for part, vectors in channels:
            features = resize_map(part.permute(2, 0, 1), size).float()
            dots += features.permute(1, 2, 0) @ vectors.T
            squares += features.square().sum(0)
        temperature = calibrated(TEMPERATURE, words.cosines(target.flatten(0, 1).float()))
        cosines = dots / squares.sqrt().clamp_min(1e-12)[..., None]
        return self.named(queries.relevancy_of_cosines(cosines, temperature), size)


def open_scorer(truth: GroundTruth, clip: str, device: torch.device | str) -> LanguageScorer:
    """Open the scorer for targets made with this CLIP (name or folder)."""
    return LanguageScorer(truth, load_image_text_encoder(clip, device).encode_texts)
