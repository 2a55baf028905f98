"""Thresholds: the relevancy above which Gaussians match a prompt."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.query.doubt import DOUBTFUL, peaks

EVEN = 0.5
"""Relevancy where prompt and negatives match equally well."""
SHARE = 0.3
"""Where matches begin, as a fraction of the way from the median Gaussian's relevancy to a prompt's peak.
Tuned on the validation landmarks (docs/lab/words.md)."""


def match_thresholds(
    relevancy: Float[Tensor, "q n"], doubts: Sequence[float], named: Sequence[bool]
) -> tuple[float, ...]:
    """Compute for each prompt the relevancy above which Gaussians match.

    Small and thin things blur with their surroundings in CLIP's crops, and seldom beat every negative there.
    So the threshold is relative to the scene, and never above `EVEN`. Doubtful prompts use `EVEN`, because
    their peaks carry no information. So do the `named` ones, which have negatives of their own to beat.
    """
    if relevancy.shape[1] == 0:
        return (EVEN,) * len(relevancy)
    low = relevancy.median(dim=1).values
    levels = (low + SHARE * (peaks(relevancy) - low)).clamp_max(EVEN).tolist()
    strict = [doubt > DOUBTFUL or names for doubt, names in zip(doubts, named, strict=True)]
    return tuple(EVEN if one else level for one, level in zip(strict, levels, strict=True))


def matching(maps: Float[Tensor, "q ..."], thresholds: Sequence[float]) -> Bool[Tensor, "q ..."]:
    """Return where each prompt's relevancy exceeds its threshold."""
    return maps > maps.new_tensor(list(thresholds)).view(-1, *[1] * (maps.dim() - 1))
