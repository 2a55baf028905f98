"""Average precision of score maps, with mean and deviation over photos."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array


def average_precision(score: Float[Array, "*shape"], truth: Bool[Array, "*shape"]) -> float | None:
    """AP = Σ (R_n − R_{n−1}) P_n over all pixels, as in scikit-learn; None without a positive pixel.

    Equal scores form one step, so the order of pixels does not matter.
    Raises ValueError on NaN or on shapes that differ.
    """
    from sklearn.metrics import average_precision_score

    if score.shape != truth.shape:
        raise ValueError(f"the score map has shape {score.shape}, the truth {truth.shape}")
    if not truth.any():
        return None
    return float(average_precision_score(truth.ravel(), score.ravel()))


def mean_over_photos(photos: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Mean of every figure over the photos that have it, in order of first appearance."""
    values = _by_name(photos)
    return {name: float(np.mean(found)) for name, found in values.items()}


def deviation_over_photos(photos: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Sample standard deviation of every figure over the photos that have it; 0 for a single photo."""
    values = _by_name(photos)
    return {name: float(np.std(v, ddof=1)) if len(v) > 1 else 0.0 for name, v in values.items()}


def _by_name(photos: Iterable[Mapping[str, float]]) -> dict[str, list[float]]:
    values: dict[str, list[float]] = {}
    for photo in photos:
        for name, value in photo.items():
            values.setdefault(name, []).append(value)
    return values
