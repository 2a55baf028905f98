"""Relevancy of features to prompts, against negatives (LERF's formula)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.memory import with_less_memory
from lang3dxl_ns.words.taught_words import TaughtWord

CANONICAL = ("object", "things", "stuff", "texture")
"""Phrases that match anything (LERF). A prompt wins where its cosine exceeds those of all of them."""
TEMPERATURE = 20.0
"""Softmax temperature for cosines of the spread `SPREAD`; LERF's code uses 10. It changes neither a
Gaussian's rank nor the 0.5 contour, but a pixel blends several Gaussians (docs/lab/words.md)."""
SPREAD = 0.272
"""Spread of the built-in CLIP's cosines (`spread`) in scenes like those it was trained on."""
_LEAST_SPREAD = 1e-4
Decode = Callable[[Float[Tensor, "n code"]], Float[Tensor, "n c"]]
"""Function from codes to raw CLIP features, such as `SemanticField.decode_clip`."""
_CPU_MB, _GPU_MB = 48, 256
"""Megabytes of features decoded at a time. On a CPU, small parts stay in its cache and take half the time."""


@dataclass(frozen=True)
class Queries:
    """Several prompts as vectors: each has synonyms, any of which may match, and phrases to compete with.

    Vectors shared by several prompts are stored once.
    """

    vectors: Float[Tensor, "v c"]
    """Unit vectors, and those of learned words."""
    positive: tuple[tuple[int, ...], ...]
    """For every prompt, the rows of its synonyms."""
    negative: tuple[tuple[int, ...], ...]
    """For every prompt, the rows it competes with: shared phrases and its own negatives."""
    learned: Mapping[int, TaughtWord] = field(default_factory=dict)
    """Words learned from examples, by the index of their prompt. Their vectors, of any length, come last."""

    @classmethod
    def of(
        cls,
        prompts: Sequence[Float[Tensor, "s c"]],
        canonical: Float[Tensor, "p c"],
        negatives: Sequence[Float[Tensor, "m c"]] | None = None,
        against: Sequence[Sequence[int]] | None = None,
    ) -> Queries:
        """Build queries from prompts (a row per synonym), shared phrases, and each prompt's `negatives`, all
        of any length. against: for every prompt, the indices of the shared phrases that it competes with;
        default: all. Raises ValueError if a prompt has no vector or no competitor."""
        own = [canonical[:0]] * len(prompts) if negatives is None else negatives
        chosen = [range(len(canonical))] * len(prompts) if against is None else against
        if any(len(p) == 0 or len(c) + len(n) == 0 for p, n, c in zip(prompts, own, chosen, strict=True)):
            raise ValueError("every prompt needs a vector, and a phrase to compete with")
        blocks = [canonical]
        positive, negative, rows = [], [], len(canonical)
        for prompt, extra, shared in zip(prompts, own, chosen, strict=True):
            blocks += [prompt, extra]
            positive.append(tuple(range(rows, rows + len(prompt))))
            rows += len(prompt)
            negative.append((*shared, *range(rows, rows + len(extra))))
            rows += len(extra)
        return cls(F.normalize(torch.cat(blocks), dim=-1), tuple(positive), tuple(negative))

    def taught(self, words: Sequence[TaughtWord | None]) -> Queries:
        """Return the prompts with learned words, one per prompt or None. Their margin is
        vector · unit feature + bias + text · (margin of the text)."""
        learned = {i: word for i, word in enumerate(words) if word is not None}
        rows = [word.vector.to(self.vectors)[None] for word in learned.values()]
        return replace(self, vectors=torch.cat([self.vectors, *rows]), learned=learned)

    def to(self, device: torch.device | str) -> Queries:
        """Return a copy on another device."""
        return replace(self, vectors=self.vectors.to(device))

    def cosines(self, features: Float[Tensor, "... c"]) -> Float[Tensor, "... v"]:
        """Compute the cosine of every feature with every vector; 0 for a zero feature."""
        return F.normalize(features, dim=-1) @ self.vectors.T

    def relevancy_of_cosines(
        self, cosines: Float[Tensor, "... v"], temperature: float = TEMPERATURE
    ) -> Float[Tensor, "q ..."]:
        """Compute sigmoid(τ (max over synonyms − max over competitors)), which is the smallest softmax of the
        best synonym against each competitor (LERF, Kerr et al. 2023): 0…1, above 0.5 where the prompt wins.
        Prompts learned from examples use the margin described at `taught`."""
        rivals = {rows: _largest(cosines, rows) for rows in set(self.negative)}  # most prompts share theirs
        margins = [
            _largest(cosines, mine) - rivals[theirs]
            for mine, theirs in zip(self.positive, self.negative, strict=True)
        ]
        first = len(self.vectors) - len(self.learned)
        for row, (i, word) in enumerate(self.learned.items(), start=first):
            margins[i] = cosines[..., row] + word.bias + word.text * margins[i]
        return torch.sigmoid(temperature * torch.stack(margins))


def spread(cosines: Float[Tensor, "n w"]) -> float:
    """Measure how widely a feature's cosines with a fixed set of words vary: their standard deviation, as
    root mean square over the features with a direction (finite cosines, not all 0); 0 without any."""
    known = (cosines.isfinite() & (cosines != 0)).any(1)
    return float(cosines[known].var(1, correction=0).mean().sqrt()) if known.any() else 0.0


def calibrated(temperature: float, cosines: Float[Tensor, "n w"]) -> float:
    """Compute the temperature at which an encoder's margins mean what the built-in CLIP's mean. A relevancy
    at this temperature does not change if all cosines (with `TextEncoder.yardstick`) are scaled or shifted:
    encoders' vary by ±.5 or by ±.05. If their spread is 0, the temperature is returned unchanged."""
    own = spread(cosines)
    return temperature * SPREAD / max(own, _LEAST_SPREAD) if own else temperature


def _largest(cosines: Float[Tensor, "... v"], rows: tuple[int, ...]) -> Float[Tensor, "..."]:
    """Compute the maximum of some columns, one column at a time to avoid copying them all."""
    largest = cosines[..., rows[0]]
    for row in rows[1:]:
        largest = torch.maximum(largest, cosines[..., row])
    return largest


def in_chunks(
    work: Callable[[Tensor], Tensor], values: Float[Tensor, "n d"], width: int, max_mb: float
) -> Float[Tensor, "n k"]:
    """Do work on a part of the rows at a time, so that three float32 copies of its `width` numbers per row
    take at most `max_mb` megabytes, or less if memory is short."""
    rows = max(int(max_mb * 2**20 / (3 * 4 * width)), 1)
    return with_less_memory(lambda rows: torch.cat([work(part) for part in values.split(rows)]), rows)


@torch.no_grad()
def cosines_of_codes(
    decode: Decode, codes: Float[Tensor, "n code"], queries: Queries
) -> Float[Tensor, "n v"]:
    """Compute the exact cosines of codes, decoded `in_chunks` to avoid a feature map of an image."""
    most = _GPU_MB if codes.is_cuda else _CPU_MB
    return in_chunks(lambda part: queries.cosines(decode(part)), codes, queries.vectors.shape[-1], most)
