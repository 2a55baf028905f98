"""Families of image-text encoders: how each reads texts, and how its patches become comparable with them.

A contrastive encoder is trained to compare one vector per picture with one per text. To compare its patches
with texts as well, the last step that mixes them is replaced, by a published recipe for each family. Or a
head reads them in small windows, together with the same place in larger ones: a wall, or a tower's wall."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from math import isqrt
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lang3dxl_ns.preparation.model_files import whole

Features = Literal["crops", "dense"]
"""Reading of a photo: one vector for each of many crops, or a map of patch features in a few passes."""
Patches = Callable[[Any, Float[Tensor, "n 3 h w"]], Float[Tensor, "n p c"]]
"""Function from model and normalized pictures to patch features by row, without class and register tokens."""
FILE = "patches.safetensors"
"""Name of the head's file, beside the CLIP's weights; the built-in CLIP has one. It is not part of the CLIP's
identity, because the vectors of texts do not depend on it."""
_DROPPED = 0.2


def own_patches(model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n p c"]:
    """Compute the patch tokens as they are: TIPSv2 (Cao et al. 2026) is trained to align them with texts."""
    tokens = model.get_image_features(**vision_inputs(model, pictures)).last_hidden_state
    return tokens[:, 1 + model.config.vision_config.num_register_tokens :]  # two class tokens come first


def patch_tokens(model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n p d"]:
    """Compute a CLIPModel's patch tokens after the tower's last normalization, which a head reads."""
    tower = model.vision_model
    return tower.post_layernorm(tower(**vision_inputs(model, pictures)).last_hidden_state[:, 1:])


def value_value_patches(model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n p c"]:
    """Compute CLIP's patches with a last block that attends from values to values (CLIP Surgery, Li et al.
    2023), without its residual connection and feed-forward layer (ClearCLIP, Lan et al. 2024)."""
    tower = model.vision_model
    hidden = tower.pre_layrnorm(tower.embeddings(pictures, interpolate_pos_encoding=True))
    *layers, last = tower.encoder.layers
    for layer in layers:
        hidden = layer(hidden, None)
    attention = last.self_attn
    values = attention.v_proj(last.layer_norm1(hidden))
    values = values.unflatten(-1, (-1, attention.head_dim)).transpose(1, 2)
    mixed = F.scaled_dot_product_attention(values, values, values, scale=attention.scale)
    patches = attention.out_proj(mixed.transpose(1, 2).flatten(2))[:, 1:]
    return model.visual_projection(tower.post_layernorm(patches))


def singly_pooled_patches(model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n p c"]:
    """Compute a SigLIP's patches, each pooled as if it were the only one: its value replaces an average of
    values, as in MaskCLIP (Zhou, Loy and Dai 2022) for CLIP's attention pooling."""
    tower = model.vision_model
    tokens = tower(**vision_inputs(model, pictures)).last_hidden_state
    pooled = torch.cat([tower.head(patch[:, None]) for patch in tokens.flatten(0, 1).split(_POOLED)])
    return pooled.unflatten(0, tokens.shape[:2])


_POOLED = 16_384
"""Number of patches pooled at a time, to bound memory."""


@dataclass(frozen=True)
class Family:
    """Common properties of the encoders of one model type."""

    recipe: str
    """Name of the recipe for patches, which is part of a target's settings."""
    patches: Patches
    features: Features = "crops"
    """Default way of reading photos, which gives the best features."""
    fixed_length: bool = False
    """Whether the encoder was trained with lower-case texts padded to its full length."""
    text_inputs: tuple[str, ...] = ("input_ids", "attention_mask")
    """Inputs of the text tower; a SigLIP was trained with unmasked padding."""
    first_position: int = 0
    """Number of the first text position; an XLM-RoBERTa counts from after its padding token."""


_VALUE_VALUE = "value-value"
_SIGLIP = Family("singly pooled", singly_pooled_patches, fixed_length=True, text_inputs=("input_ids",))
FAMILIES: dict[str, Family] = {
    "clip": Family(_VALUE_VALUE, value_value_patches),
    "metaclip_2": Family(_VALUE_VALUE, value_value_patches),
    "altclip": Family(_VALUE_VALUE, value_value_patches, first_position=2),
    "siglip": _SIGLIP,
    "siglip2": _SIGLIP,
    "tipsv2": Family("patch tokens", own_patches, "dense", fixed_length=True),
}
"""Families by model type in config.json. Checkpoints of SigLIP 2 with a fixed resolution are `siglip`."""


def input_side(vision: Any) -> int:
    """Return the side in pixels of a vision tower's training pictures, by its configuration. A SigLIP 2 of
    any resolution has a number of patches instead."""
    patches = getattr(vision, "num_patches", None)
    return vision.image_size if patches is None else isqrt(patches) * vision.patch_size


def vision_inputs(model: Any, pictures: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor | bool]:
    """Build the arguments of a vision tower; positions are interpolated for sizes not seen in training."""
    vision = model.config.vision_config
    if model.config.model_type == "siglip2":
        return _as_patches(pictures, vision.patch_size)
    if model.config.model_type == "tipsv2":  # always interpolates
        return {"pixel_values": pictures}
    return {"pixel_values": pictures, "interpolate_pos_encoding": True}


def _as_patches(pictures: Float[Tensor, "n 3 h w"], side: int) -> dict[str, Tensor | bool]:
    """Convert pictures to the input of a SigLIP 2 of any resolution: flat patches, mask and grid shape."""
    tiles = pictures.unfold(2, side, side).unfold(3, side, side)  # n 3 rows columns side side
    count, _, rows, columns = tiles.shape[:4]
    patches = tiles.permute(0, 2, 3, 4, 5, 1).reshape(count, rows * columns, -1)
    shapes = torch.tensor([[rows, columns]], device=pictures.device).repeat(count, 1)
    mask = torch.ones(patches.shape[:2], dtype=torch.int32, device=pictures.device)
    return {"pixel_values": patches, "pixel_attention_mask": mask, "spatial_shapes": shapes}


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
