"""A linear head that reads a CLIP's patch tokens as its texts are read, trained beside it.

A crop's embedding is one vector for everything in the crop. A patch token sees all of the crop and stands
for its patch alone.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.preparation.families import vision_inputs
from lang3dxl_ns.preparation.model_files import whole

FILE = "patches.safetensors"
"""Name of the head's file, beside the CLIP's weights; the built-in CLIP has one. It is not part of the CLIP's
identity, because the vectors of texts do not depend on it."""


@dataclass(frozen=True)
class PatchHead:
    """The head: a linear layer on the patch tokens after the tower's last normalization."""

    weight: Float[Tensor, "c d"]
    bias: Float[Tensor, " c"]

    def patches(self, model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n p c"]:
        """Compute the features of a CLIPModel's patches, row by row, from normalized pictures."""
        tower = model.vision_model
        tokens = tower(**vision_inputs(model, pictures)).last_hidden_state[:, 1:]
        return F.linear(tower.post_layernorm(tokens), self.weight, self.bias)


def read_patch_head(folder: Path, device: torch.device | str) -> PatchHead | None:
    """Read the head in a CLIP's folder; None if there is none. Raises UserError if it is damaged."""
    from safetensors.torch import load_file

    path = folder / FILE
    if not path.is_file():
        return None
    with whole(f"{path} can't be read", "remove it, or restore it"):
        tensors = load_file(path, str(device))
        return PatchHead(tensors["weight"], tensors["bias"])


def head_recipe(folder: Path) -> str | None:
    """Return the name of the recipe of maps made by the head in a CLIP's folder; None if there is none."""
    path = folder / FILE
    if not path.is_file():
        return None
    return f"head {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"
