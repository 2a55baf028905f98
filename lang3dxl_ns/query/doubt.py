"""Doubt about a prompt: how many words for things that are surely absent fit the scene as well.

A relevancy above 0.5 somewhere proves little: among many Gaussians a few fit any text, nonsense too. So the
scene is also asked for unrelated things, and a prompt is ranked among them by its best Gaussians. Nothing
here depends on the encoder or the scene (conformal p-values: Vovk, Gammerman & Shafer 2005).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.query.relevancy import Queries

UNRELATED = (
    "saxophone", "spaceship", "harmonica", "bagpipe", "necktie", "banjo", "xylophone", "chessboard",
    "flamingo", "ostrich", "igloo", "hedgehog", "raccoon", "headphones", "platypus", "armadillo", "walrus",
    "iguana", "scorpion", "syringe", "otter", "koala", "typewriter", "gorilla", "hippopotamus", "cactus",
    "rhinoceros", "peacock", "hamburger", "toucan", "seahorse", "snowman", "squid", "blender", "accordion",
    "corkscrew", "dishwasher", "sushi", "snorkel", "trampoline", "hammock", "treadmill", "dartboard",
    "stapler", "dumbbell", "pretzel", "lobster", "croissant", "avocado", "trombone", "pineapple",
    "watermelon", "balloon", "lipstick", "tuxedo", "iceberg", "thermometer", "stethoscope", "bowling ball",
    "calculator",
)  # fmt: skip
"""Things that photos of a building hardly show. The built-in CLIP has learned none of them: those of its own
training's absent things would be told apart more easily than what people ask for."""
DOUBTFUL = 0.1
"""A prompt with more doubt than this is reported as doubtful: so are nine in ten absent things."""
LEAST_PEAK = 0.012
"""A prompt that fits no place better than this is in doubt whatever the unrelated words do: all of them may
fit even less. Present things reach 0.3 and more."""
BEST = 0.005
"""Share of the Gaussians that a prompt's fit is read from."""
_AT_A_TIME = 4
"""Unrelated words asked together."""


class Doubts:
    """Doubt about prompts in one scene.

    Args:
        relevancy: of every Gaussian to queries, 0 where unknown: `QueryEngine.of_gaussians`.
        queries: of texts as they are, without synonyms: `TextEncoder.plain_queries`.
    """

    def __init__(
        self,
        relevancy: Callable[[Queries], Float[Tensor, "q n"]],
        queries: Callable[[Sequence[str]], Queries],
    ) -> None:
        self._relevancy, self._queries = relevancy, queries

    def of(self, relevancy: Float[Tensor, "q n"]) -> list[float]:
        """For each prompt, from the relevancy of all Gaussians to it, the share of texts, itself among them,
        that fit the scene at least as well: (1 + #{u ≥ prompt}) / (1 + 60). At most x with a probability of x
        for an absent thing. 1 for a prompt that fits nowhere (`LEAST_PEAK`)."""
        unrelated = self.unrelated
        return [
            (1 + int((unrelated >= peak).sum())) / (1 + len(unrelated)) if peak >= LEAST_PEAK else 1.0
            for peak in peaks(relevancy)
        ]

    @cached_property
    def unrelated(self) -> Float[Tensor, " u"]:
        """How well the unrelated words fit: `peaks`. A few are asked at a time, since all of them to millions
        of Gaussians would take gigabytes."""
        self._queries(UNRELATED)  # encodes them together
        parts = [UNRELATED[i : i + _AT_A_TIME] for i in range(0, len(UNRELATED), _AT_A_TIME)]
        return torch.cat([peaks(self._relevancy(self._queries(part))) for part in parts])


def peaks(relevancy: Float[Tensor, "q n"]) -> Float[Tensor, " q"]:
    """How well each prompt fits where it fits best: the mean relevancy of the best 0.5 % of the Gaussians.
    0 without Gaussians."""
    if relevancy.shape[1] == 0:
        return relevancy.new_zeros(len(relevancy))
    return relevancy.topk(math.ceil(BEST * relevancy.shape[1]), dim=1).values.mean(1)


def doubtful(text: str, doubt: float, taught: bool = False) -> str | None:
    """A sentence about a doubtful prompt; None for the others. taught: whether it was taught by example."""
    if doubt <= DOUBTFUL:
        return None
    if taught:
        return (
            f"doubtful: {doubt:.0%} of what was not marked as {text!r} fits as well: mark it in more photos"
        )
    if doubt == 1.0:
        return f"doubtful: {text!r} fits no place: it may be absent, or the run's CLIP may not know the word"
    return (
        f"doubtful: {doubt:.0%} of unrelated words fit this scene as well as {text!r}: it may not be here, "
        f"or the run's CLIP may not know the word"
    )
