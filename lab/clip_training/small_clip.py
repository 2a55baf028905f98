"""The small CLIP: tokenizer, two towers, loading and saving."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lab.clip_training.captions import corpus
from lang3dxl_ns.preparation.encoders import ImageTextEncoder

IMAGE_SIZE, PATCH = 48, 12
GRID = IMAGE_SIZE // PATCH
"""Patches along a side."""
_CONTEXT = 24
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's, as for dense encoders
BRIGHTNESS = 0.6
"""Mean value of the landmarks' views."""


def build_tokenizer(seed: int) -> Any:
    """A lower-case CLIPTokenizer learned from the captions; its byte alphabet can spell any text."""
    from tokenizers import Tokenizer, models, pre_tokenizers, trainers
    from transformers import CLIPTokenizer

    learner = Tokenizer(models.BPE(end_of_word_suffix="</w>"))
    learner.pre_tokenizer = pre_tokenizers.Whitespace()
    trainer = trainers.BpeTrainer(vocab_size=600, end_of_word_suffix="</w>", show_progress=False)
    learner.train_from_iterator(corpus(np.random.default_rng(seed)), trainer)
    merges: Any = [tuple(pair) for pair in json.loads(learner.to_str())["model"]["merges"]]
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    merged = ["".join(pair) for pair in merges]
    words = [*letters, *(letter + "</w>" for letter in letters), *merged, "<|startoftext|>", "<|endoftext|>"]
    vocabulary = {word: index for index, word in enumerate(dict.fromkeys(words))}
    return CLIPTokenizer(vocab=vocabulary, merges=merges, model_max_length=_CONTEXT)


def build_clip(tokenizer: Any, seed: int) -> Any:
    """A CLIPModel with random weights."""
    from transformers import CLIPConfig, CLIPModel

    text = {
        "hidden_size": 128,
        "intermediate_size": 512,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "hidden_act": "gelu",  # one kernel; CLIP's own quick_gelu is three
        "vocab_size": len(tokenizer),
        "max_position_embeddings": _CONTEXT,
        "bos_token_id": tokenizer.bos_token_id,
        "eos_token_id": tokenizer.eos_token_id,
        "pad_token_id": tokenizer.pad_token_id,
    }
    vision = {
        "hidden_size": 128,
        "intermediate_size": 512,
        "num_hidden_layers": 4,
        "num_attention_heads": 4,
        "hidden_act": "gelu",  # one kernel; CLIP's own quick_gelu is three
        "image_size": IMAGE_SIZE,
        "patch_size": PATCH,
    }
    config = CLIPConfig(
        text_config=text, vision_config=vision, projection_dim=96, logit_scale_init_value=float(np.log(10.0))
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return CLIPModel(config)


@torch.no_grad()
def load_clip(folder: Path, layers: int) -> tuple[Any, Any]:
    """A saved model to continue training, and its tokenizer.

    Missing vision layers are appended as identities: copies of the last one with zero output
    projections.
    """
    from transformers import CLIPConfig, CLIPModel, CLIPTokenizer

    old = CLIPModel.from_pretrained(folder, local_files_only=True)
    config: Any = CLIPConfig.from_pretrained(folder)
    config.vision_config.num_hidden_layers = max(layers, config.vision_config.num_hidden_layers)
    clip = CLIPModel(config)
    clip.load_state_dict(old.state_dict(), strict=False)
    trained = old.vision_model.encoder.layers
    for layer in clip.vision_model.encoder.layers[len(trained) :]:
        layer.load_state_dict(trained[-1].state_dict())
        for projection in (layer.self_attn.out_proj, layer.mlp.fc2):
            projection.weight.zero_()
            projection.bias.zero_()
    return clip, CLIPTokenizer.from_pretrained(folder, local_files_only=True)


@torch.no_grad()
def start_from_principal_components(clip: Any, pixels: Float[Tensor, "n 3 s s"]) -> None:
    """Make the patch embedding the whitened principal components of the patches of these (normalized) crops.

    With random filters, whose outputs all follow a patch's mean color, a small transformer spends tens of
    thousands of crops before it sees anything else.
    """
    weight = clip.vision_model.embeddings.patch_embedding.weight
    patches = torch.nn.functional.unfold(pixels, PATCH, stride=PATCH).transpose(1, 2).flatten(0, 1)
    variances, components = torch.linalg.eigh(patches.T @ patches / len(patches))
    largest = slice(-weight.shape[0], None)
    scale = (variances[largest] + 0.01 * variances.mean()).rsqrt()
    weight.copy_((0.3 * components[:, largest] * scale).T.reshape(weight.shape))


def normalize(pixels: Float[Tensor, "n 3 s s"]) -> Float[Tensor, "n 3 s s"]:
    """Pixels in 0..1, normalized for the vision tower."""
    return (pixels - torch.tensor(_MEAN)[:, None, None]) / torch.tensor(_STD)[:, None, None]


def as_encoder(clip: Any, tokenizer: Any) -> ImageTextEncoder:
    """The present model, with the interface used in preparation."""
    return ImageTextEncoder(clip, tokenizer, _MEAN, _STD, "in training", BRIGHTNESS)


def save_clip(clip: Any, tokenizer: Any, folder: Path) -> None:
    """Write the model, its tokenizer and its image processor as a Hugging Face folder."""
    from transformers import CLIPImageProcessor

    clip.save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    tokenizer.backend_tokenizer.model.save(str(folder))  # vocab.json and merges.txt, for other readers
    sides = {"height": IMAGE_SIZE, "width": IMAGE_SIZE}
    processor = CLIPImageProcessor(
        size={"shortest_edge": IMAGE_SIZE},
        crop_size=sides,
        image_mean=list(_MEAN),
        image_std=list(_STD),
        brightness=BRIGHTNESS,
    )
    processor.save_pretrained(folder)
