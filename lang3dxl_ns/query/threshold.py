"""The relevancy from which a place matches a prompt, read off the scene itself."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.query.doubt import DOUBTFUL, peaks

EVEN = 0.5
"""Relevancy where prompt and negatives fit equally well."""
SHARE = 0.3
"""Of the way from the median Gaussian's relevancy to a prompt's peak, where matches begin; chosen on
landmarks for decisions (docs/lab/words.md)."""
COVERED = 0.3
"""Share of a pixel that matching Gaussians must cover: most matches are small, and edges blend."""


def match_thresholds(
    relevancy: Float[Tensor, "q n"], doubts: Sequence[float], named: Sequence[bool]
) -> tuple[float, ...]:
    """For each prompt the relevancy above which Gaussians match.

    Small and thin things blur with their surroundings in the crops that CLIP sees, and seldom beat every
    negative there. So what stands out in the scene matches: at most `EVEN` is asked for, and that of doubtful
    prompts, whose peaks mean nothing.

    Args:
        relevancy: of all Gaussians to the prompts.
        doubts: about the prompts, as `Doubts.of` tells.
        named: whether a prompt names negatives of its own, which have to be beaten: `EVEN` again.
    """
    if relevancy.shape[1] == 0:
        return (EVEN,) * len(relevancy)
    low = relevancy.median(dim=1).values
    levels = (low + SHARE * (peaks(relevancy) - low)).clamp_max(EVEN).tolist()
    strict = [doubt > DOUBTFUL or names for doubt, names in zip(doubts, named, strict=True)]
    return tuple(EVEN if one else level for one, level in zip(strict, levels, strict=True))


def matching(maps: Float[Tensor, "q ..."], thresholds: Sequence[float]) -> Bool[Tensor, "q ..."]:
    """Where each prompt matches."""
    return maps > maps.new_tensor(list(thresholds)).view(-1, *[1] * (maps.dim() - 1))
