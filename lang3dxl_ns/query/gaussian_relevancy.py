"""Relevancy of Gaussians: features are decoded once per scene, and a prompt then takes one matrix product."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lang3dxl_ns.common.memory import with_less_memory
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.query.relevancy import TEMPERATURE, Queries

_CHUNK_MB = 64


@dataclass(frozen=True)
class GaussianFeatures:
    """The exact direction of every Gaussian's CLIP feature, in as few numbers as its decoder allows.

    A decoder whose last layer is linear, d = W h + b, gives cos(d, t) = ((h, 1) · (Wᵀt, b·t)) / |d|. The
    hidden activations h and |d| therefore suffice, whatever the width of CLIP is. Rows are (h, 1) / |d|.
    """

    rows: Float[Tensor, "n r"]
    """Half-precision row of each Gaussian; 0 for unknown Gaussians."""
    head: Float[Tensor, "r c"] | None
    """Matrix (Wᵀ; b), which turns a row into a unit feature. None if rows are unit features already."""
    known: Bool[Tensor, " n"]
    """Which Gaussians have a feature; the others are visible in no photo."""

    @classmethod
    @torch.no_grad()
    def of(cls, decoder: Decoder, codes: Float[Tensor, "n d"]) -> GaussianFeatures:
        """Decode the codes of Gaussians, where NaN marks an unknown one."""
        layer = decoder.clip_head()
        narrow = layer is not None and layer[0].shape[1] < layer[0].shape[0]
        head = torch.cat([layer[0].T, layer[1][None]]) if narrow and layer else None
        gram = None if head is None else (head.double() @ head.double().T).to(head)

        def decode(part: Float[Tensor, "m d"]) -> Float[Tensor, "m r"]:
            seen = part.isfinite().all(1, keepdim=True)
            part = torch.where(seen, part, 0.0)
            if gram is None:
                rows = F.normalize(decoder.decode_clip(part), dim=-1)
            else:
                rows = F.pad(decoder.hidden(part), (0, 1), value=1.0)
                rows = rows / ((rows @ gram) * rows).sum(1, keepdim=True).clamp_min(1e-12).sqrt()
            # A feature that all but vanishes carries no information, and its row may exceed half precision.
            return torch.where(seen & (rows.abs() < 6e4).all(1, keepdim=True), rows, 0.0).half()

        rows = _in_chunks(decode, codes, decoder.clip_dim)
        return cls(rows, head, (rows != 0).any(1))

    def some(self, count: int) -> GaussianFeatures:
        """Return about `count` of the known Gaussians, evenly chosen."""
        rows = self.rows[self.known]
        rows = rows[:: max(len(rows) // count, 1)]
        return GaussianFeatures(rows, self.head, torch.ones_like(rows[:, 0], dtype=torch.bool))

    @torch.no_grad()
    def features(self, which: slice | Int[Tensor, " m"]) -> Float[Tensor, "m c"]:
        """Return the unit features of some Gaussians; 0 where unknown."""
        rows = self.rows[which].float()
        return rows if self.head is None else rows @ self.head

    @torch.no_grad()
    def cosines(self, queries: Queries) -> Float[Tensor, "n v"]:
        """Compute the cosine of every Gaussian with every vector; 0 where unknown."""
        vectors = queries.vectors.T if self.head is None else self.head @ queries.vectors.T
        return _in_chunks(lambda part: part.float() @ vectors, self.rows, self.rows.shape[1])

    def relevancy(self, queries: Queries, temperature: float = TEMPERATURE) -> Float[Tensor, "q n"]:
        """Compute the relevancy of every Gaussian to every prompt, 0…1; 0 where unknown."""
        return queries.relevancy_of_cosines(self.cosines(queries), temperature) * self.known


def _in_chunks(work, values: Float[Tensor, "n d"], width: int) -> Tensor:
    chunk = max(int(_CHUNK_MB * 2**20) // (3 * 4 * width), 1)
    return with_less_memory(lambda rows: torch.cat([work(part) for part in values.split(rows)]), chunk)
