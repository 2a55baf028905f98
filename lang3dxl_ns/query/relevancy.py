"""How relevant a feature is to a prompt: the prompt against canonical phrases that mean nothing special."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

CANONICAL = ("object", "things", "stuff", "texture")
"""Phrases that fit anything (LERF): a prompt is found where it fits better than all of these."""
TEMPERATURE = 10.0
"""As in LERF's code. The ranking of pixels and the 0.5 contour don't depend on it."""


def relevancy(
    features: Float[Tensor, "... c"],
    queries: Float[Tensor, "q c"],
    canonical: Float[Tensor, "p c"],
    temperature: float = TEMPERATURE,
) -> Float[Tensor, "q ..."]:
    """min over c of exp(τ s_q) / (exp(τ s_q) + exp(τ s_c)) = sigmoid(τ (s_q − max_c s_c)), s = cosine.

    0…1; above 0.5 where the query fits better than every canonical phrase. Vectors need no unit length; a
    zero feature (nothing rendered) gives 0.5. Source: LERF, Kerr et al. 2023.
    """
    unit = F.normalize(features, dim=-1)
    similar = (unit @ F.normalize(queries, dim=-1).T).movedim(-1, 0)
    neutral = (unit @ F.normalize(canonical, dim=-1).T).amax(-1)
    return torch.sigmoid(temperature * (similar - neutral))


@torch.no_grad()
def relevancy_of_codes(
    decode: Callable[[Float[Tensor, "n code"]], Float[Tensor, "n c"]],
    codes: Float[Tensor, "... code"],
    queries: Float[Tensor, "q c"],
    canonical: Float[Tensor, "p c"],
    temperature: float = TEMPERATURE,
    max_mb: float = 256.0,
) -> Float[Tensor, "q ..."]:
    """Relevancy of rendered codes, decoded a chunk at a time: no feature map of the whole image ever exists.

    decode: `SemanticField.decode_clip`. max_mb: memory of a chunk's features, about (three copies of
    float32 live at once).
    """
    flat = codes.reshape(-1, codes.shape[-1])
    chunk = max(int(max_mb * 2**20 / (3 * 4 * queries.shape[-1])), 1)
    parts = [relevancy(decode(part), queries, canonical, temperature) for part in flat.split(chunk)]
    return torch.cat(parts, 1).reshape(len(queries), *codes.shape[:-1])
