"""Small random image-text encoders and SAM 3, written as their published checkpoints are.

from tiny_teachers import make_tiny_siglip
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import torch
from tiny_models import TOWER, byte_tokenizer, save_random, text_tower

LETTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ ,.'"
TEXT = {**TOWER, "max_position_embeddings": 64}


def make_tiny_siglip(folder: Path, side: int = 32, patch: int = 8, seed: int = 0) -> Path:
    """As google/siglip-base-patch16-224: SentencePiece unigrams, no attention mask, [0.5] statistics."""
    from transformers import SiglipImageProcessor, SiglipTokenizer

    model = write_sentencepiece(folder / "spiece.model", "unigram")
    tokenizer = SiglipTokenizer(str(model), model_input_names=["input_ids"], model_max_length=64)
    _save_siglip(folder, tokenizer, len(tokenizer), side, patch, seed)
    SiglipImageProcessor(size={"height": side, "width": side}).save_pretrained(folder)
    return folder


def make_tiny_siglip2(folder: Path, side: int = 32, patch: int = 8, seed: int = 0) -> Path:
    """As google/siglip2-base-patch16-224: model type `siglip`, Gemma's tokenizer, which keeps capitals."""
    from transformers import SiglipImageProcessor

    tokenizer = _gemma_tokenizer()
    _save_siglip(folder, tokenizer, len(tokenizer), side, patch, seed)
    size = {"height": side, "width": side}
    SiglipImageProcessor(size=size, resample=2).save_pretrained(folder)
    return folder


def make_tiny_siglip2_naflex(folder: Path, patch: int = 8, patches: int = 16, seed: int = 0) -> Path:
    """As google/siglip2-base-patch16-naflex: model type `siglip2`, pictures as flat patches."""
    from transformers import Siglip2Config, Siglip2ImageProcessor, Siglip2Model

    tokenizer = _gemma_tokenizer()
    config = Siglip2Config(
        text_config={**TEXT, "vocab_size": len(tokenizer), "projection_size": TOWER["hidden_size"]},
        vision_config={**TOWER, "patch_size": patch, "num_patches": patches},
    )
    save_random(Siglip2Model, config, folder, seed)
    tokenizer.save_pretrained(folder)
    Siglip2ImageProcessor(patch_size=patch, max_num_patches=patches).save_pretrained(folder)
    return folder


def make_tiny_tipsv2(folder: Path, side: int = 56, patch: int = 14, seed: int = 0) -> Path:
    """As google/tipsv2-b14: two class tokens, byte pairs of SentencePiece, pictures not normalized."""
    from transformers import Tipsv2Config, Tipsv2ImageProcessor, Tipsv2Model, Tipsv2Tokenizer

    folder.mkdir(parents=True, exist_ok=True)
    write_sentencepiece(folder / "tokenizer.model", "bpe")
    tokenizer = Tipsv2Tokenizer.from_pretrained(folder)
    config = Tipsv2Config(
        text_config={**TEXT, "vocab_size": len(tokenizer)},
        vision_config={
            **{name: TOWER[name] for name in ("hidden_size", "num_hidden_layers", "num_attention_heads")},
            "image_size": side,
            "patch_size": patch,
        },
    )
    save_random(Tipsv2Model, config, folder, seed)
    tokenizer.save_pretrained(folder)
    Tipsv2ImageProcessor(size={"height": side, "width": side}).save_pretrained(folder)
    return folder


def make_tiny_metaclip2(folder: Path, side: int = 32, patch: int = 8, seed: int = 0) -> Path:
    """As facebook/metaclip-2-worldwide-huge-quickgelu: XLM-RoBERTa's tokenizer, end of text 2."""
    from transformers import MetaClip2Config, MetaClip2Model

    tokenizer = _xlm_roberta_tokenizer(77)
    text = {**TOWER, "vocab_size": len(tokenizer), "max_position_embeddings": 77, "eos_token_id": 2}
    config = MetaClip2Config(text_config=text, vision_config=_vision(side, patch), projection_dim=24)
    save_random(MetaClip2Model, config, folder, seed)
    return _save_clip_like(folder, tokenizer, side)


def make_tiny_altclip(folder: Path, side: int = 32, patch: int = 8, seed: int = 0) -> Path:
    """As BAAI/AltCLIP: an XLM-RoBERTa for texts, whose positions count from 2."""
    from transformers import AltCLIPConfig, AltCLIPModel

    tokenizer = _xlm_roberta_tokenizer(77)
    text = {**TOWER, "vocab_size": len(tokenizer), "max_position_embeddings": 34, "project_dim": 24}
    config = AltCLIPConfig(text_config=text, vision_config=_vision(side, patch), projection_dim=24)
    save_random(AltCLIPModel, config, folder, seed)
    return _save_clip_like(folder, tokenizer, side)


def make_tiny_sam3(folder: Path, side: int = 56, seed: int = 0) -> Path:
    """As facebook/sam3: the detector inside a video model's configuration and weights."""
    from safetensors.torch import load_file, save_file
    from transformers import Sam3Config, Sam3ImageProcessor, Sam3Model, Sam3Processor

    width = {"hidden_size": 32, "intermediate_size": 64, "num_attention_heads": 2}
    layers = {**width, "num_layers": 2}
    tokenizer = byte_tokenizer()
    config = Sam3Config(
        vision_config={
            "backbone_config": {
                "model_type": "sam3_vit_model",
                **width,
                "num_hidden_layers": 2,
                "image_size": side,
                "patch_size": 14,
                "pretrain_image_size": 28,
                "window_size": 2,
                "global_attn_indexes": [1],
            },
            "fpn_hidden_size": 32,
            "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
        },
        text_config={**text_tower(tokenizer), "model_type": "clip_text_model", "projection_dim": 16},
        geometry_encoder_config=layers,
        detr_encoder_config=layers,
        detr_decoder_config={**layers, "num_queries": 6},
        mask_decoder_config={"hidden_size": 32, "num_attention_heads": 2},
    )
    save_random(Sam3Model, config, folder, seed)
    weights = load_file(folder / "model.safetensors")
    prefixed = {f"detector_model.{name}": tensor for name, tensor in weights.items()}
    save_file(prefixed, folder / "model.safetensors", metadata={"format": "pt"})
    detector = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(
        json.dumps(
            {"model_type": "sam3_video", "architectures": ["Sam3VideoModel"], "detector_config": detector}
        )
    )
    size = {"height": side, "width": side}
    processor = Sam3ImageProcessor(size=size, mask_size={"height": side // 4, "width": side // 4})
    Sam3Processor(processor, tokenizer).save_pretrained(folder)
    return folder


TEACHERS: dict[str, Callable[[Path], Path]] = {
    "siglip": make_tiny_siglip,
    "siglip2": make_tiny_siglip2,
    "siglip2-naflex": make_tiny_siglip2_naflex,
    "tipsv2": make_tiny_tipsv2,
    "metaclip2": make_tiny_metaclip2,
    "altclip": make_tiny_altclip,
}
"""Makers by a short name."""


def write_sentencepiece(path: Path, kind: str) -> Path:
    """A SentencePiece model of a few pieces, ids as in Google's checkpoints."""
    import sentencepiece

    path.parent.mkdir(parents=True, exist_ok=True)
    sentences = [
        "a rose window",
        "the dome of a mosque",
        "minaret",
        "seen from far away in the evening light",
    ]
    unigram = {"pad_id": -1, "eos_id": 1, "unk_id": 2, "bos_id": -1} if kind == "unigram" else {}
    special = unigram or {"pad_id": 0, "unk_id": 1, "bos_id": -1, "eos_id": -1, "byte_fallback": True}
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter(sentences * 20),
        model_prefix=str(path.with_suffix("")),
        vocab_size=40 if kind == "unigram" else 320,
        model_type=kind,
        hard_vocab_limit=False,
        minloglevel=2,
        **special,
    )
    path.with_suffix(".vocab").unlink()
    if path.suffix == ".model":
        return path
    return path.with_suffix(".model").rename(path)


def _gemma_tokenizer():
    from transformers import GemmaTokenizer

    pieces = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>", "▁", *LETTERS.replace(" ", "")]
    bytes_ = [f"<0x{i:02X}>" for i in range(256)]
    vocabulary = {piece: i for i, piece in enumerate([*pieces, *bytes_])}
    return GemmaTokenizer(
        vocab=vocabulary,
        merges=[],
        model_input_names=["input_ids"],
        padding_side="right",
        model_max_length=64,
    )


def _xlm_roberta_tokenizer(length: int):
    from transformers import XLMRobertaTokenizer

    pieces = ["<s>", "<pad>", "</s>", "<unk>", "▁", *LETTERS.replace(" ", ""), "<mask>"]
    scores = [0.0 if piece.startswith("<") else -float(1 + i) for i, piece in enumerate(pieces)]
    return XLMRobertaTokenizer(vocab=list(zip(pieces, scores, strict=True)), model_max_length=length)


def _vision(side: int, patch: int) -> dict:
    return {**TOWER, "image_size": side, "patch_size": patch}


def _save_siglip(folder: Path, tokenizer, words: int, side: int, patch: int, seed: int) -> None:
    from transformers import SiglipConfig, SiglipModel

    config = SiglipConfig(
        text_config={**TEXT, "vocab_size": words, "projection_size": TOWER["hidden_size"]},
        vision_config=_vision(side, patch),
    )
    save_random(SiglipModel, config, folder, seed)
    tokenizer.save_pretrained(folder)


def _save_clip_like(folder: Path, tokenizer, side: int) -> Path:
    from transformers import CLIPImageProcessor

    tokenizer.save_pretrained(folder)
    sides = {"height": side, "width": side}
    CLIPImageProcessor(size={"shortest_edge": side}, crop_size=sides).save_pretrained(folder)
    return folder


def random_picture(*shape: int, seed: int = 0) -> torch.Tensor:
    """RGB in 0…1 with every level a whole number of 255ths, as files have it."""
    levels = torch.randint(0, 256, shape, generator=torch.Generator().manual_seed(seed))
    return levels / 255
