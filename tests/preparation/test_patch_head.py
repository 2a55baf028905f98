"""The head that reads patch tokens as texts are read, and maps of training photos by it."""

from __future__ import annotations

import shutil

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from tiny_models import make_tiny_clip
from tiny_teachers import random_picture
from transformers import CLIPModel

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation import encoders
from lang3dxl_ns.preparation.dense_map import fine_grid
from lang3dxl_ns.preparation.encoders import load_image_text_encoder, patch_reading
from lang3dxl_ns.preparation.model_files import CLIP_OPTION, find_model
from lang3dxl_ns.preparation.patch_head import FILE, head_recipe


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A CLIP whose head is a random linear layer."""
    monkeypatch.setattr(encoders, "_multiplies_bfloat16", lambda: False)
    clip = make_tiny_clip(tmp_path / "clip")
    model, generator = CLIPModel.from_pretrained(clip), torch.Generator().manual_seed(0)
    shape = model.visual_projection.weight.shape
    head = {
        "weight": torch.randn(shape, generator=generator),
        "bias": torch.randn(shape[0], generator=generator),
    }
    save_file(head, clip / FILE)
    return clip


@torch.no_grad()
def test_patches_are_the_heads_reading_of_their_tokens(folder):
    encoder, model = load_image_text_encoder(folder, "cpu"), CLIPModel.from_pretrained(folder).eval()
    pictures = torch.rand(2, 3, encoder.crop_size, encoder.crop_size)
    tokens = model.vision_model(pixel_values=(pictures - encoder._mean) / encoder._std).last_hidden_state[
        :, 1:
    ]
    plain = load_file(folder / FILE)
    expected = F.linear(model.vision_model.post_layernorm(tokens), plain["weight"], plain["bias"])
    found = encoder.encode_patches(pictures).flatten(1, 2)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_a_head_changes_neither_the_identity_of_its_clip_nor_its_embeddings(folder, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(folder, bare)
    (bare / FILE).unlink()
    with_head, without = (load_image_text_encoder(clip, "cpu") for clip in (folder, bare))
    assert find_model(folder, CLIP_OPTION).identity == find_model(bare, CLIP_OPTION).identity
    assert torch.equal(with_head.encode_texts(["dome"]), without.encode_texts(["dome"]))
    crops = random_picture(2, 3, with_head.crop_size, with_head.crop_size)
    assert torch.equal(with_head.encode_images(crops), without.encode_images(crops))
    assert patch_reading(str(bare), "auto") is None


def test_another_head_is_another_recipe(folder):
    before = head_recipe(folder)
    head = load_file(folder / FILE)
    save_file({**head, "bias": head["bias"] + 1}, folder / FILE)
    assert head_recipe(folder) not in (before, None)


def test_crops_are_read_where_they_are_requested(folder):
    assert patch_reading(str(folder), "crops") is None
    found, dense = (patch_reading(str(folder), features) for features in ("auto", "dense"))
    assert found is not None and dense is not None and found.beside_crops and not dense.beside_crops
    assert found.recipe == dense.recipe == head_recipe(folder)


def test_a_damaged_head_is_named(folder):
    (folder / FILE).write_bytes(b"damaged")
    with pytest.raises(UserError, match=FILE):
        load_image_text_encoder(folder, "cpu")


@pytest.mark.parametrize("size", [(360, 480), (90, 40), (5, 1000)])
def test_a_windows_patches_cover_its_side(size):
    side, tokens = 32, 4
    for length, patches in zip(size, fine_grid(*size, tokens, side), strict=True):
        assert patches == max(round(length / (side / tokens)), tokens)
