"""Random-weight models, small enough for tests, saved as folders that the real loading code reads offline."""

from __future__ import annotations

from pathlib import Path

import torch


def make_tiny_clip(folder: Path, dim: int = 64, image_size: int = 32, seed: int = 0) -> Path:
    """A CLIP with `dim` joint channels, its image processor, and a tokenizer over bytes. Returns `folder`."""
    from tokenizers.pre_tokenizers import ByteLevel
    from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel, CLIPTokenizer

    letters = sorted(ByteLevel.alphabet())
    words = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    vocabulary = {word: index for index, word in enumerate(words)}
    tower = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    start, end = vocabulary["<|startoftext|>"], vocabulary["<|endoftext|>"]
    config = CLIPConfig(
        text_config={
            **tower,
            "vocab_size": len(vocabulary),
            "max_position_embeddings": 32,
            "bos_token_id": start,
            "eos_token_id": end,
            "pad_token_id": end,
        },
        vision_config={**tower, "image_size": image_size, "patch_size": image_size // 4},
        projection_dim=dim,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        CLIPModel(config).save_pretrained(folder)
    CLIPTokenizer(vocab=vocabulary, merges=[]).save_pretrained(folder)
    sides = {"height": image_size, "width": image_size}
    CLIPImageProcessor(size={"shortest_edge": image_size}, crop_size=sides).save_pretrained(folder)
    return Path(folder)


def make_tiny_dinov2(folder: Path, dim: int = 32, patch: int = 14, grid: int = 4, seed: int = 0) -> Path:
    """A DINOv2 with `dim` channels, made for `grid`×`grid` patches of `patch` px. Returns `folder`."""
    from transformers import Dinov2Config, Dinov2Model

    config = Dinov2Config(
        hidden_size=dim, num_hidden_layers=2, num_attention_heads=2, patch_size=patch, image_size=patch * grid
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        Dinov2Model(config).save_pretrained(folder)
    return Path(folder)
