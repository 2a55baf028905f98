"""Random-weight models, small enough for tests, saved as folders that the real loading code reads offline."""

from __future__ import annotations

from pathlib import Path

import torch

TOWER = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
WORDS = ("building", "tower", "window", "sky", "tree")


def make_tiny_clip(folder: Path, dim: int = 64, image_size: int = 32, seed: int = 0) -> Path:
    """A CLIP with `dim` joint channels, its image processor, and a tokenizer over bytes. Returns `folder`."""
    from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel

    tokenizer = byte_tokenizer()
    config = CLIPConfig(
        text_config=text_tower(tokenizer),
        vision_config={**TOWER, "image_size": image_size, "patch_size": image_size // 4},
        projection_dim=dim,
    )
    save_random(CLIPModel, config, folder, seed)
    tokenizer.save_pretrained(folder)
    sides = {"height": image_size, "width": image_size}
    CLIPImageProcessor(size={"shortest_edge": image_size}, crop_size=sides).save_pretrained(folder)
    return Path(folder)


def make_tiny_clipseg(folder: Path, image_size: int = 32, seed: int = 0) -> Path:
    """A CLIPSeg with its processor and a tokenizer over bytes. Returns `folder`."""
    from transformers import CLIPSegConfig, CLIPSegForImageSegmentation, CLIPSegProcessor, ViTImageProcessor

    tokenizer = byte_tokenizer()
    config = CLIPSegConfig(
        text_config=text_tower(tokenizer),
        vision_config={**TOWER, "image_size": image_size, "patch_size": image_size // 4},
        projection_dim=32,
        extract_layers=[0, 1],
        reduce_dim=16,
        decoder_num_attention_heads=2,
        decoder_intermediate_size=32,
        initializer_factor=20.0,  # otherwise every pixel gets the same answer
    )
    save_random(CLIPSegForImageSegmentation, config, folder, seed)
    sides = {"height": image_size, "width": image_size}
    CLIPSegProcessor(ViTImageProcessor(size=sides), tokenizer).save_pretrained(folder)
    return Path(folder)


def make_tiny_grounding_dino(folder: Path, seed: int = 0) -> Path:
    """A GroundingDINO that proposes ten boxes, knows `WORDS`, and its processor. Returns `folder`."""
    from transformers import (
        BertTokenizer,
        GroundingDinoConfig,
        GroundingDinoForObjectDetection,
        GroundingDinoImageProcessor,
        GroundingDinoProcessor,
        SwinConfig,
    )

    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "?", *WORDS]
    tokenizer = BertTokenizer(vocab={word: index for index, word in enumerate(words)})
    backbone = SwinConfig(
        image_size=32,
        patch_size=4,
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 1, 1],
        window_size=2,
        out_features=["stage2", "stage3", "stage4"],
    )
    layers = {
        f"{part}_{what}": value
        for part in ("encoder", "decoder")
        for what, value in (("layers", 2), ("ffn_dim", 16), ("attention_heads", 2))
    }
    config = GroundingDinoConfig(
        backbone_config=backbone,
        text_config={**TOWER, "model_type": "bert", "vocab_size": len(words), "max_position_embeddings": 32},
        d_model=32,
        num_queries=10,
        max_text_len=32,
        **layers,
    )
    save_random(GroundingDinoForObjectDetection, config, folder, seed)
    image_processor = GroundingDinoImageProcessor(size={"shortest_edge": 64, "longest_edge": 96})
    GroundingDinoProcessor(image_processor, tokenizer).save_pretrained(folder)
    return Path(folder)


def make_tiny_sam(folder: Path, image_size: int = 64, seed: int = 0) -> Path:
    """A SAM that sees `image_size` px, with its processor. Returns `folder`."""
    from transformers import SamConfig, SamImageProcessor, SamModel, SamProcessor

    decoder = {"hidden_size": 16, "mlp_dim": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    config = SamConfig(
        vision_config={
            **decoder,
            "image_size": image_size,
            "patch_size": 8,
            "output_channels": 16,
            "window_size": 4,
            "global_attn_indexes": [1],
            "num_pos_feats": 8,
        },
        prompt_encoder_config={
            "hidden_size": 16,
            "image_size": image_size,
            "patch_size": 8,
            "mask_input_channels": 4,
        },
        mask_decoder_config={**decoder, "iou_head_hidden_dim": 16},
    )
    save_random(SamModel, config, folder, seed)
    side = {"height": image_size, "width": image_size}
    processor = SamImageProcessor(size={"longest_edge": image_size}, pad_size=side)
    SamProcessor(processor).save_pretrained(folder)
    return Path(folder)


def save_random(model_class, config, folder: Path, seed: int) -> None:
    """A model of random weights in `folder`; the global generator stays as it is."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model_class(config).save_pretrained(folder)


def byte_tokenizer():
    """CLIP's tokenizer with one token per byte and no others."""
    from tokenizers.pre_tokenizers import ByteLevel
    from transformers import CLIPTokenizer

    letters = sorted(ByteLevel.alphabet())
    words = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    return CLIPTokenizer(vocab={word: index for index, word in enumerate(words)}, merges=[])


def text_tower(tokenizer) -> dict:
    """Settings of a text tower for this tokenizer."""
    return {
        **TOWER,
        "vocab_size": len(tokenizer),
        "max_position_embeddings": 32,
        "bos_token_id": tokenizer.bos_token_id,
        "eos_token_id": tokenizer.eos_token_id,
        "pad_token_id": tokenizer.eos_token_id,
    }


def make_tiny_dinov2(folder: Path, dim: int = 32, patch: int = 14, grid: int = 4, seed: int = 0) -> Path:
    """A DINOv2 with `dim` channels, made for `grid`×`grid` patches of `patch` px. Returns `folder`."""
    from transformers import Dinov2Config, Dinov2Model

    config = Dinov2Config(
        hidden_size=dim, num_hidden_layers=2, num_attention_heads=2, patch_size=patch, image_size=patch * grid
    )
    save_random(Dinov2Model, config, folder, seed)
    return Path(folder)
