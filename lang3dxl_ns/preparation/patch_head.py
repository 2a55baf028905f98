"""A head that reads a CLIP's patch tokens as its texts are read, in windows of several sizes.

A crop's embedding is one vector for everything in the crop, and knows nothing of what is around it. A patch
token stands for its patch. The head reads a patch in small windows, which show what it is made of, together
with the same place in larger windows, which show what it is a part of: a wall, or a tower's wall.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.preparation.model_files import whole

FILE = "patches.safetensors"
"""Name of the head's file, beside the CLIP's weights; the built-in CLIP has one. It is not part of the CLIP's
identity, because the vectors of texts do not depend on it."""
_DROPPED = 0.2


class PatchHead(nn.Module):
    """Patch tokens (of `width` channels) of a place, in windows of several `sizes` → a feature to compare
    with texts' vectors (of `channels`).

    The feature is a linear function of the token in the smallest windows, corrected by a network with one
    hidden layer that sees the tokens of all sizes."""

    def __init__(self, width: int, channels: int, sizes: int, hidden: int) -> None:
        super().__init__()
        self.sizes = sizes
        self.direct = nn.Linear(width, channels)
        self.norm = nn.LayerNorm(sizes * width)
        self.inner = nn.Linear(sizes * width, hidden)
        self.outer = nn.Linear(hidden, channels)

    def forward(self, tokens: Float[Tensor, "sizes ... d"]) -> Float[Tensor, "... c"]:
        """Compute the features from tokens of unit length, coarse to fine."""
        x = self.norm(tokens.movedim(0, -2).flatten(-2))
        x = F.gelu(self.inner(F.dropout(x, _DROPPED, self.training)))
        return self.direct(tokens[-1]) + self.outer(F.dropout(x, _DROPPED, self.training))


def read_patch_head(folder: Path, device: torch.device | str) -> PatchHead | None:
    """Read the head in a CLIP's folder; None if there is none. Raises UserError if it is damaged."""
    from safetensors.torch import load_file

    path = folder / FILE
    if not path.is_file():
        return None
    with whole(f"{path} can't be read", "remove it, or restore it"):
        tensors = load_file(path, str(device))
        channels, width = tensors["direct.weight"].shape
        hidden, inputs = tensors["inner.weight"].shape
        head = PatchHead(width, channels, inputs // width, hidden)
        head.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        return head.to(device).eval().requires_grad_(False)


def head_recipe(folder: Path) -> tuple[str, int] | None:
    """Return the name of the recipe of maps made by the head in a CLIP's folder, and its number of window
    sizes; None if there is none. Raises UserError if it is damaged."""
    from safetensors import safe_open

    path = folder / FILE
    if not path.is_file():
        return None
    with whole(f"{path} can't be read", "remove it, or restore it"), safe_open(path, "pt") as file:
        inputs, width = (file.get_slice(f"{name}.weight").get_shape()[1] for name in ("inner", "direct"))
    return f"head {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}", inputs // width
