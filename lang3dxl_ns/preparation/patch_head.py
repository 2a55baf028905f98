"""A linear head that reads a CLIP's patch tokens as its texts are read, trained beside it.

A crop's embedding says one thing about all that the crop shows; a patch token sees all of the crop, and
stands for its patch alone.
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
"""In the CLIP's folder, beside its weights: the built-in one has it. It is no part of the CLIP's identity,
because the vectors of texts don't depend on it."""


@dataclass(frozen=True)
class PatchHead:
    """Weight and bias of the head."""

    weight: Float[Tensor, "c d"]
    bias: Float[Tensor, " c"]

    def patches(self, model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n p c"]:
        """Features of a CLIPModel's patches, row by row, of normalized pictures."""
        tower = model.vision_model
        tokens = tower(**vision_inputs(model, pictures)).last_hidden_state[:, 1:]
        return F.linear(tower.post_layernorm(tokens), self.weight, self.bias)


def read_patch_head(folder: Path, device: torch.device | str) -> PatchHead | None:
    """The head in a CLIP's folder; None if there is none. Raises UserError if it can't be read."""
    from safetensors.torch import load_file

    path = folder / FILE
    if not path.is_file():
        return None
    with whole(f"{path} can't be read", "remove it, or restore it"):
        tensors = load_file(path, str(device))
        return PatchHead(tensors["weight"], tensors["bias"])


def head_recipe(folder: Path) -> str | None:
    """Name of the recipe of maps that the head in a CLIP's folder makes; None if there is none."""
    path = folder / FILE
    if not path.is_file():
        return None
    return f"head {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"
