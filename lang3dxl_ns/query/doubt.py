"""Doubt about a prompt: the share of words for absent things that match the scene as well as the prompt.

A relevancy above 0.5 somewhere proves little, since among many Gaussians a few match any text, even nonsense.
So unrelated words are queried too, and a prompt is ranked among them by its best Gaussians. The rule does not
depend on the encoder or the scene (conformal p-values: Vovk, Gammerman & Shafer 2005).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
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
"""Things that rarely appear in photos of buildings. The built-in CLIP was trained on none of them, since it
would reject absent things from its training more easily than the words that users enter."""
DOUBTFUL = 0.04
"""Prompts above this are reported as doubtful, as all but one absent thing in thirty are: at most one
unrelated word may fit as well (docs/lab/words.md)."""
DOUBTFUL_TAUGHT = 0.1
"""The same for words taught by example, whose doubt is measured in what was not marked."""
LEAST_PEAK = 0.05
"""Prompts with a lower peak are doubtful whatever unrelated words reach. Most present things reach 0.3."""
BEST = 0.005
"""Share of the Gaussians that a prompt's peak is the mean of."""
_AT_A_TIME = 4
"""Number of unrelated words that are queried together."""


@dataclass(frozen=True)
class Doubts:
    """Doubt about prompts in one scene."""

    relevancy: Callable[[Queries], Float[Tensor, "q n"]]
    """Computes every Gaussian's relevancy, 0 where unknown (`QueryEngine.of_gaussians`)."""
    queries: Callable[[Sequence[str]], Queries]
    """Encodes texts as they are, without synonyms (`TextEncoder.plain_queries`)."""
    _alone: dict[str, float] = field(default_factory=dict, init=False)

    def of(self, relevancy: Float[Tensor, "q n"]) -> list[float]:
        """Compute each prompt's doubt from the Gaussians' relevancy: the share of texts, itself among
        them, that match the scene at least as well, (1 + #{u ≥ prompt}) / (1 + 60), or 1 below `LEAST_PEAK`.
        For an absent thing, a doubt of at most x has a probability of at most x."""
        unrelated = self.unrelated
        return [
            (1 + int((unrelated >= peak).sum())) / (1 + len(unrelated)) if peak >= LEAST_PEAK else 1.0
            for peak in peaks(relevancy)
        ]

    def alone(self, text: str) -> float:
        """Return the doubt about a text without its synonyms, which is computed once."""
        if text not in self._alone:
            self._alone[text] = self.of(self.relevancy(self.queries([text])))[0]
        return self._alone[text]

    @cached_property
    def unrelated(self) -> Float[Tensor, " u"]:
        """Peaks of the unrelated words (`peaks`). A few words are queried at a time, since the relevancy of
        millions of Gaussians to all of them would take gigabytes."""
        self.queries(UNRELATED)  # encodes all of them in one batch
        parts = [UNRELATED[i : i + _AT_A_TIME] for i in range(0, len(UNRELATED), _AT_A_TIME)]
        return torch.cat([peaks(self.relevancy(self.queries(part))) for part in parts])


def peaks(relevancy: Float[Tensor, "q n"]) -> Float[Tensor, " q"]:
    """Compute each prompt's peak, the mean relevancy of the best 0.5 % of the Gaussians; 0 without Gaussians.
    The share is rounded up, to one Gaussian at least."""
    if relevancy.shape[1] == 0:
        return relevancy.new_zeros(len(relevancy))
    return relevancy.topk(math.ceil(BEST * relevancy.shape[1]), dim=1).values.mean(1)


def doubtful(text: str, doubt: float, taught: bool = False) -> str | None:
    """Describe a doubtful prompt; return None for the others. taught: whether it was taught by example."""
    if doubt <= (DOUBTFUL_TAUGHT if taught else DOUBTFUL):
        return None
    unknown = "or the run's CLIP may not know the word"
    if taught:
        why = f"{doubt:.0%} of what was not marked as {text!r} fits as well: mark it in more photos"
    elif doubt == 1.0:
        why = f"{text!r} matches nothing in this scene: it may be absent, {unknown}"
    else:
        fit = f"{doubt:.0%} of unrelated words fit this scene as well as {text!r}"
        why = f"{fit}: it may not be here, {unknown}"
    return f"doubtful: {why}"
