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
from lang3dxl_ns.preparation.dense_map import nested_grids
from lang3dxl_ns.preparation.encoders import load_image_text_encoder, patch_reading
from lang3dxl_ns.preparation.families import FILE, PatchHead, head_recipe
from lang3dxl_ns.preparation.model_files import CLIP_OPTION, find_model

SIZES = 3


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A CLIP with a random head for windows of three sizes."""
    monkeypatch.setattr(encoders, "multiplies_bfloat16", lambda: False)
    clip = make_tiny_clip(tmp_path / "clip")
    channels, width = CLIPModel.from_pretrained(clip).visual_projection.weight.shape
    torch.manual_seed(0)
    save_file(PatchHead(width, channels, SIZES, 7).state_dict(), clip / FILE)
    return clip


@torch.no_grad()
def test_patches_of_a_clip_with_a_head_are_its_towers_tokens(folder):
    encoder, model = load_image_text_encoder(folder, "cpu"), CLIPModel.from_pretrained(folder).eval()
    pictures = torch.rand(2, 3, encoder.crop_size, encoder.crop_size)
    hidden = model.vision_model(pixel_values=(pictures - encoder._mean) / encoder._std).last_hidden_state
    expected = model.vision_model.post_layernorm(hidden[:, 1:])
    torch.testing.assert_close(encoder.encode_patches(pictures).flatten(1, 2), expected)


def test_the_head_is_a_linear_layer_and_a_correction_by_all_sizes(folder):
    plain = load_file(folder / FILE)
    width = plain["direct.weight"].shape[1]
    tokens = F.normalize(torch.randn(SIZES, 40, 5, width), dim=-1)
    found = load_image_text_encoder(folder, "cpu").join_sizes(tokens)
    for row, column in ((0, 0), (15, 2), (16, 2), (39, 4)):
        sizes = tokens[:, row, column]
        x = sizes.flatten()
        x = (x - x.mean()) / (x.var(correction=0) + 1e-5).sqrt()
        x = F.gelu(plain["inner.weight"] @ x + plain["inner.bias"])
        expected = plain["direct.weight"] @ sizes[-1] + plain["direct.bias"]
        expected = expected + plain["outer.weight"] @ x + plain["outer.bias"]
        torch.testing.assert_close(found[row, column], expected, rtol=1e-4, atol=1e-5)


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
    save_file({**head, "direct.bias": head["direct.bias"] + 1}, folder / FILE)
    after = head_recipe(folder)
    assert before is not None and after is not None
    assert before[0] != after[0] and before[1] == after[1] == SIZES


def test_crops_are_read_where_they_are_requested(folder):
    assert patch_reading(str(folder), "crops") is None
    found, dense = (patch_reading(str(folder), features) for features in ("auto", "dense"))
    assert found is not None and dense is not None and found.fine_alone and not dense.fine_alone
    assert (found.recipe, found.sizes) == (dense.recipe, dense.sizes) == head_recipe(folder)


def test_a_damaged_head_is_named(folder):
    (folder / FILE).write_bytes(b"damaged")
    with pytest.raises(UserError, match=FILE):
        load_image_text_encoder(folder, "cpu")


@pytest.mark.parametrize("size", [(360, 480), (90, 40), (5, 1000)])
def test_windows_double_from_size_to_size_and_none_exceeds_the_photo(size):
    side, tokens = 32, 4
    for n, grid in enumerate(reversed(nested_grids(*size, tokens, side, 5))):
        for length, patches in zip(size, grid, strict=True):
            assert patches == max(round(length / (side * 2**n / tokens)), tokens)
