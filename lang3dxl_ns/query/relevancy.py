"""Relevancy of features to prompts, against negatives (LERF's formula)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.memory import with_less_memory
from lang3dxl_ns.query.teach import TaughtWord

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
_CPU_CHUNK = 8192
"""Codes decoded at a time on a CPU."""


@dataclass(frozen=True)
class Probe:
    """A linear score of features, learned from examples, that is added to the margin of a prompt's text."""

    row: int
    """Row of the score's direction among the vectors."""
    length: float
    """Margin per unit of the cosine with the direction."""
    bias: float
    """Margin where the cosine is 0."""
    text: float
    """Weight of the text's own margin, at least 0."""


@dataclass(frozen=True)
class Queries:
    """Several prompts as vectors: each has synonyms, any of which may match, and phrases to compete with.

    Vectors shared by several prompts are stored once.
    """

    vectors: Float[Tensor, "v c"]
    """Vectors of unit length."""
    positive: tuple[tuple[int, ...], ...]
    """For every prompt, the rows of its synonyms."""
    negative: tuple[tuple[int, ...], ...]
    """For every prompt, the rows it competes with: shared phrases and its own negatives."""
    probes: tuple[Probe | None, ...] = ()
    """For every prompt, the score learned from examples, or None; empty if no prompt has one."""

    @classmethod
    def of(
        cls,
        prompts: Sequence[Float[Tensor, "s c"]],
        canonical: Float[Tensor, "p c"],
        negatives: Sequence[Float[Tensor, "m c"]] | None = None,
        against: Sequence[Sequence[int]] | None = None,
    ) -> Queries:
        """Build queries from prompts (a row per synonym), shared phrases, and each prompt's `negatives`.

        against: for every prompt, the indices of the shared phrases that it competes with; default: all.
        Vectors need not have unit length. Raises ValueError if a prompt has no vector or no competitor.
        """
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
        """Return the prompts with learned words, whose margin is vector · unit feature + bias + text ·
        (margin of the text).

        Args:
            words: one per prompt; None for prompts without a learned word.
        """
        rows, probes = [self.vectors], list[Probe | None]()
        for word in words:
            probe = None
            if word is not None:
                vector = word.vector.to(self.vectors)
                probe = Probe(len(self.vectors) + len(rows) - 1, float(vector.norm()), word.bias, word.text)
                rows.append(F.normalize(vector, dim=0)[None])
            probes.append(probe)
        return replace(self, vectors=torch.cat(rows), probes=tuple(probes))

    def __len__(self) -> int:
        return len(self.positive)

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
        margins = [
            _largest(cosines, mine) - _largest(cosines, theirs)
            for mine, theirs in zip(self.positive, self.negative, strict=True)
        ]
        for i, probe in enumerate(self.probes):
            if probe is not None:
                learned = probe.length * cosines[..., probe.row] + probe.bias
                margins[i] = learned + probe.text * margins[i]
        return torch.sigmoid(temperature * torch.stack(margins))


def spread(cosines: Float[Tensor, "n w"]) -> float:
    """Measure how widely a feature's cosines with a fixed set of words vary: their standard deviation, as
    root mean square over the features. Features without a direction, whose cosines are all 0 or not finite,
    are ignored; 0 if none is left."""
    known = (cosines.isfinite() & (cosines != 0)).any(1)
    return float(cosines[known].var(1, correction=0).mean().sqrt()) if known.any() else 0.0


def calibrated(temperature: float, cosines: Float[Tensor, "n w"]) -> float:
    """Compute the temperature at which an encoder's margins mean what the built-in CLIP's mean.

    Encoders differ in how widely their cosines vary: by ±.5 or by ±.05. A relevancy at the calibrated
    temperature does not change if all cosines are scaled or shifted.

    Args:
        temperature: temperature for the built-in CLIP; returned unchanged if the spread is 0.
        cosines: cosines of a scene's features with words for present and absent things
            (`TextEncoder.yardstick`).
    """
    own = spread(cosines)
    return temperature * SPREAD / max(own, _LEAST_SPREAD) if own else temperature


def _largest(cosines: Float[Tensor, "... v"], rows: tuple[int, ...]) -> Float[Tensor, "..."]:
    """Compute the maximum of some columns, one column at a time to avoid copying them all."""
    largest = cosines[..., rows[0]]
    for row in rows[1:]:
        largest = torch.maximum(largest, cosines[..., row])
    return largest


def relevancy(
    features: Float[Tensor, "... c"],
    queries: Float[Tensor, "q c"],
    canonical: Float[Tensor, "p c"],
    temperature: float = TEMPERATURE,
) -> Float[Tensor, "q ..."]:
    """Compute min_c exp(τ s_q) / (exp(τ s_q) + exp(τ s_c)) = sigmoid(τ (s_q − max_c s_c)), s = cosine.

    The result is in 0…1, above 0.5 where the query beats every canonical phrase. Vectors need not have unit
    length. A zero feature (nothing rendered) gives 0.5. Source: LERF, Kerr et al. 2023.
    """
    prompts = Queries.of(queries[:, None].unbind(), canonical)
    return prompts.relevancy_of_cosines(prompts.cosines(features), temperature)


@torch.no_grad()
def cosines_of_codes(
    decode: Decode, codes: Float[Tensor, "n code"], queries: Queries, max_mb: float = 256.0
) -> Float[Tensor, "n v"]:
    """Compute the exact cosines of codes, decoded in chunks to avoid a feature map of the whole image.

    max_mb: approximate memory of a chunk's features (three float32 copies exist at once). Chunks are smaller
    if memory is short, and on a CPU, where small chunks stay in its cache and take half the time.
    """
    chunk = max(int(max_mb * 2**20 / (3 * 4 * queries.vectors.shape[-1])), 1)
    if not codes.is_cuda:
        chunk = min(chunk, _CPU_CHUNK)
    return with_less_memory(
        lambda rows: torch.cat([queries.cosines(decode(part)) for part in codes.split(rows)]), chunk
    )


def relevancy_of_codes(
    decode: Decode,
    codes: Float[Tensor, "... code"],
    queries: Queries,
    temperature: float = TEMPERATURE,
    max_mb: float = 256.0,
) -> Float[Tensor, "q ..."]:
    """Compute the exact relevancy of rendered codes (`cosines_of_codes`)."""
    flat = codes.reshape(-1, codes.shape[-1])
    cosines = cosines_of_codes(decode, flat, queries, max_mb)
    return queries.relevancy_of_cosines(cosines, temperature).reshape(len(queries), *codes.shape[:-1])
