"""Search for codes that a trained field decodes to given features: in a list, then by Gauss-Newton steps.

The field's last layer is linear, d = W h + b, so the error |d − f|² = hᵀG h − 2 hᵀy + const with G = WᵀW and
y = Wᵀ(f − b). Once y is known, its cost depends on the hidden width alone, not on the width of the features.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.components.semantic_field import SemanticField

Head = tuple[Float[Tensor, "c hidden"], Float[Tensor, " c"]]
"""Weight W and bias b of a linear last layer."""

_STEPS = 6
_AXES = 32
"""Number of principal components of the decoded features in which the nearest is searched."""
_LISTED = 8_192
"""Largest number of codes that are searched."""
_DIFFERENCE = 1e-2
"""Step of the finite differences, which is of the order of a cell of the finest level."""
_FARTHEST = 6.0
"""Largest absolute value of a code; beyond it, the sigmoid hardly changes."""


@torch.no_grad()
def nearest(
    field: SemanticField, head: Head, codes: Float[Tensor, "m code"], features: Float[Tensor, "n c"]
) -> Float[Tensor, "n code"]:
    """Find, for each feature, the code that decodes nearest to it. Distances are measured in the leading
    principal components of the decoded features. Of more than `_LISTED` codes, evenly spaced ones are
    searched."""
    codes = codes[:: -(-len(codes) // _LISTED)]
    decoded = F.linear(field.hidden(codes), *head)
    mean = decoded.mean(0)
    axes = torch.linalg.eigh((decoded - mean).T @ (decoded - mean))[1][:, -_AXES:]
    listed, asked = (decoded - mean) @ axes, (features - mean) @ axes
    norms = 0.5 * listed.square().sum(1)
    found = [torch.addmm(norms, part, listed.T, alpha=-1).argmin(1) for part in asked.split(2048)]
    return codes[torch.cat(found)]


@torch.no_grad()
def settle(
    field: SemanticField, head: Head, codes: Float[Tensor, "n code"], features: Float[Tensor, "n c"]
) -> Float[Tensor, "n code"]:
    """Move codes so that they decode nearer to the features (Levenberg 1944, Marquardt 1963). A code for
    which no step is better is returned as it is."""
    weight, bias = head
    gram, wanted = weight.T @ weight, (features - bias) @ weight

    def state(codes):
        hidden = field.hidden(codes)
        slope = hidden @ gram
        return hidden, slope, (hidden * (slope - 2 * wanted)).sum(1)

    hidden, slope, error = state(codes)
    damping = torch.full_like(error, 1e-2)
    for _ in range(_STEPS):
        moved = [
            (field.hidden(codes + axis) - hidden) / _DIFFERENCE
            for axis in _DIFFERENCE * torch.eye(codes.shape[1], device=codes.device, dtype=codes.dtype)
        ]
        turned = [part @ gram for part in moved]
        matrix = torch.stack([torch.stack([(a * b).sum(1) for b in turned], 1) for a in moved], 2)
        right = torch.stack([(part * (slope - wanted)).sum(1) for part in moved], 1)
        diagonal = matrix.diagonal(dim1=1, dim2=2)
        ridge = damping[:, None] * (diagonal + 1e-3 * diagonal.mean(1, keepdim=True)) + 1e-9
        change = torch.linalg.solve(matrix + torch.diag_embed(ridge), right).clamp(-1, 1)
        tried = (codes - change).clamp(-_FARTHEST, _FARTHEST)
        new_hidden, new_slope, new_error = state(tried)
        better = new_error < error
        codes, hidden, slope = (
            torch.where(better[:, None], new, old)
            for new, old in ((tried, codes), (new_hidden, hidden), (new_slope, slope))
        )
        error = torch.where(better, new_error, error)
        damping = torch.where(better, 0.3 * damping, 5 * damping).clamp(1e-6, 1e4)
    return codes
