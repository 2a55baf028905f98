"""Image-text encoders of every family, on models of their real layouts, against transformers itself."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from tiny_models import make_tiny_clip
from tiny_teachers import TEACHERS, random_picture

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation import encoders
from lang3dxl_ns.preparation.encoders import ImageTextEncoder, load_image_text_encoder, patch_reading

MAKERS = {"clip": make_tiny_clip, **TEACHERS}
NEED_SENTENCEPIECE = ("siglip", "tipsv2")
TEXTS = ["A rose window", "minaret", "the dome of a mosque, seen from far away in the Evening light"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = {}

    def folder(name: str):
        if name in NEED_SENTENCEPIECE:
            pytest.importorskip("sentencepiece")
        if name not in made:
            made[name] = MAKERS[name](tmp_path_factory.mktemp("models") / name)
        return made[name]

    return folder


@pytest.fixture
def load(folders, monkeypatch):
    """An encoder in full precision, and transformers' own model."""
    from transformers import AutoModel

    monkeypatch.setattr(encoders, "multiplies_bfloat16", lambda: False)

    def loaded(name: str) -> tuple[ImageTextEncoder, torch.nn.Module]:
        return load_image_text_encoder(folders(name), "cpu"), AutoModel.from_pretrained(folders(name)).eval()

    return loaded


def own_texts(name: str, folder, texts: list[str]) -> dict[str, torch.Tensor]:
    """Tokens as transformers' documentation of each model makes them."""
    from transformers import AutoProcessor, AutoTokenizer

    if name in ("tipsv2", "siglip2-naflex"):  # their processors pad by themselves
        tokens = AutoProcessor.from_pretrained(folder)(text=texts, return_tensors="pt")
        return {key: tokens[key] for key in ("input_ids", "attention_mask") if key in tokens}
    tokenizer = AutoTokenizer.from_pretrained(folder)
    if name.startswith("siglip"):
        low = [text.lower() for text in texts]  # as all of them were trained
        return tokenizer(low, padding="max_length", max_length=64, return_tensors="pt", truncation=True)
    longest = 77 if name == "metaclip2" else 32
    return tokenizer(texts, padding=True, truncation=True, max_length=longest, return_tensors="pt")


def own_pixels(folder, pictures: torch.Tensor) -> dict[str, torch.Tensor]:
    """Pictures as transformers' processor makes them."""
    from transformers import AutoImageProcessor

    levels = (pictures * 255).round().to(torch.uint8)
    return dict(AutoImageProcessor.from_pretrained(folder)(list(levels), return_tensors="pt"))


@pytest.mark.parametrize("name", MAKERS)
@torch.no_grad()
def test_image_embeddings_are_transformers_own(load, folders, name):
    encoder, model = load(name)
    pictures = random_picture(3, 3, encoder.crop_size, encoder.crop_size)
    expected = model.get_image_features(**own_pixels(folders(name), pictures)).pooler_output
    found = encoder.encode_images(pictures)
    assert found.shape == (3, encoder.dim)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", MAKERS)
@torch.no_grad()
def test_pictures_of_another_size_are_resized_as_transformers_does(load, folders, name):
    encoder, model = load(name)
    smooth = F.interpolate(random_picture(2, 3, 6, 6), (50, 50), mode="bicubic").clamp(0, 1)
    pictures = (smooth * 255).round() / 255
    expected = model.get_image_features(**own_pixels(folders(name), pictures)).pooler_output
    found = encoder.encode_images(pictures)
    assert (found - expected).norm() < 0.02 * expected.norm()  # transformers rounds to bytes in between


@pytest.mark.parametrize("name", MAKERS)
@torch.no_grad()
def test_text_embeddings_are_transformers_own_whatever_they_are_encoded_with(load, folders, name):
    encoder, model = load(name)
    found = encoder.encode_texts(TEXTS)
    for text, embedding in zip(TEXTS, found, strict=True):
        tokens = own_texts(name, folders(name), [text])
        if name == "siglip2-naflex":  # its tokenizer's file, but not its text tower's training, has a mask
            tokens.pop("attention_mask", None)
        expected = model.get_text_features(**tokens).pooler_output[0]
        torch.testing.assert_close(embedding, expected, rtol=1e-4, atol=1e-5)
    assert (found[0] - found[1]).abs().max() > 1e-4


@pytest.mark.parametrize("name", [name for name in TEACHERS if "sig" in name or "tips" in name])
def test_capitals_change_nothing_where_texts_were_lower_case_in_training(load, name):
    encoder, _ = load(name)
    capital, low = encoder.encode_texts(["Rose Window", "rose window"])
    assert torch.equal(capital, low)


@pytest.mark.parametrize("name", ["siglip", "siglip2", "siglip2-naflex", "tipsv2", "clip", "altclip"])
@torch.no_grad()
def test_cosines_are_the_models_own_logits_but_for_its_scale_and_bias(load, folders, name):
    encoder, model = load(name)
    pictures = random_picture(2, 3, encoder.crop_size, encoder.crop_size, seed=3)
    tokens = own_texts(name, folders(name), TEXTS[:2])
    if name.startswith("siglip"):
        tokens = {"input_ids": tokens["input_ids"]}
    logits = model(**tokens, **own_pixels(folders(name), pictures)).logits_per_image
    images, texts = (
        F.normalize(found, dim=-1)
        for found in (encoder.encode_images(pictures), encoder.encode_texts(TEXTS[:2]))
    )
    scale = 1 / model.temperature if name == "tipsv2" else model.logit_scale.exp()
    expected = scale * images @ texts.T + getattr(model, "logit_bias", 0.0)
    torch.testing.assert_close(logits, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", MAKERS)
def test_patches_are_a_grid_in_the_texts_space_at_any_size(load, name):
    encoder, _ = load(name)
    side = encoder.patch_size
    for rows, columns in ((4, 4), (2, 3), (5, 4)):
        windows = random_picture(2, 3, rows * side, columns * side)
        assert encoder.encode_patches(windows).shape == (2, rows, columns, encoder.dim)
        torch.testing.assert_close(
            encoder.encode_patches(windows)[1:], encoder.encode_patches(windows[1:]), rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize("name", MAKERS)
def test_a_changed_patch_is_found_at_its_place(load, name):
    encoder, _ = load(name)
    side = encoder.patch_size
    plain = torch.full((1, 3, 3 * side, 5 * side), 0.5)
    marked = plain.clone()
    marked[..., side : 2 * side, 3 * side : 4 * side] = random_picture(3, side, side)
    change = (encoder.encode_patches(marked) - encoder.encode_patches(plain)).norm(dim=-1)
    assert divmod(int(change.argmax()), 5) == (1, 3)


@torch.no_grad()
def test_tipsv2s_patches_are_what_follows_its_two_class_tokens(load, folders):
    encoder, model = load("tipsv2")
    picture = random_picture(1, 3, encoder.crop_size, encoder.crop_size)
    tokens = model.get_image_features(**own_pixels(folders("tipsv2"), picture)).last_hidden_state
    assert tokens.shape[1] == 2 + 16
    torch.testing.assert_close(encoder.encode_patches(picture).flatten(1, 2), tokens[:, 2:])


@pytest.mark.parametrize("name", ["siglip", "siglip2", "siglip2-naflex"])
def test_a_siglip_that_sees_one_patch_pools_that_patch(load, name):
    encoder, model = load(name)
    side = encoder.patch_size
    one = random_picture(4, 3, side, side)
    from lang3dxl_ns.preparation.families import vision_inputs

    with torch.no_grad():
        pooled = model.get_image_features(**vision_inputs(model, (one - 0.5) / 0.5)).pooler_output
    torch.testing.assert_close(encoder.encode_patches(one)[:, 0, 0], pooled, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["clip", "metaclip2", "altclip"])
@torch.no_grad()
def test_a_clips_last_block_attends_from_values_to_values(load, folders, name):
    """Against loops over heads and tokens, on what transformers' own forward gives the last block."""
    encoder, model = load(name)
    picture = random_picture(1, 3, encoder.crop_size, encoder.crop_size)
    last, seen = model.vision_model.encoder.layers[-1], []
    handle = last.register_forward_pre_hook(
        lambda _, args, kwargs: seen.append((args, kwargs)), with_kwargs=True
    )
    model.get_image_features(**own_pixels(folders(name), picture))
    handle.remove()
    args, kwargs = seen[0]
    hidden = args[0] if args else kwargs["hidden_states"]
    attention, width = last.self_attn, last.self_attn.head_dim
    values = attention.v_proj(last.layer_norm1(hidden))[0].double()
    mixed = torch.zeros_like(values)
    for start in range(0, values.shape[1], width):
        head = values[:, start : start + width]
        for i, query in enumerate(head):
            weights = (head @ query / width**0.5).softmax(0)
            mixed[i, start : start + width] = (weights[:, None] * head).sum(0)
    patches = attention.out_proj(mixed.float())[1:]
    expected = model.visual_projection(model.vision_model.post_layernorm(patches))
    torch.testing.assert_close(encoder.encode_patches(picture).flatten(0, 2), expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("name", MAKERS)
def test_bfloat16_turns_features_by_a_few_degrees_at_most(load, name, monkeypatch):
    encoder, _ = load(name)
    pictures = random_picture(3, 3, encoder.crop_size, encoder.crop_size)
    exact = encoder.encode_images(pictures), encoder.encode_patches(pictures)
    monkeypatch.setattr(encoders, "multiplies_bfloat16", lambda: True)
    for before, after in zip(
        exact, (encoder.encode_images(pictures), encoder.encode_patches(pictures)), strict=True
    ):
        assert after.dtype == torch.float32 and not torch.equal(before, after)
        assert F.cosine_similarity(before, after, dim=-1).min() > 0.998


def test_only_encoders_with_aligned_patches_are_dense_unless_asked(folders):
    assert patch_reading(str(folders("clip")), "auto") is None
    assert patch_reading(str(folders("tipsv2")), "crops") is None
    reading = patch_reading(str(folders("tipsv2")), "auto")
    assert reading is not None and (reading.recipe, reading.tokens) == ("patch tokens", 4)
    reading = patch_reading(str(folders("siglip2-naflex")), "dense")
    assert reading is not None and reading.tokens == 4


def test_the_built_in_clip_can_be_read_densely():
    reading = patch_reading("builtin", "dense")
    assert reading is not None and reading.recipe.startswith("head ")
    encoder = load_image_text_encoder("builtin", "cpu")
    assert reading.sizes is not None
    tokens = encoder.encode_patches(torch.rand(reading.sizes, 3, 48, 60))
    assert encoder.join_sizes(tokens).shape == (4, 5, 96)


def test_a_tokenizer_that_cannot_be_read_names_what_to_install(folders, monkeypatch):
    from transformers import AutoTokenizer

    def fails(*_, **__):
        raise ImportError("SiglipTokenizer requires the SentencePiece library")

    monkeypatch.setattr(AutoTokenizer, "from_pretrained", fails)
    with pytest.raises(UserError, match="pip install sentencepiece"):
        load_image_text_encoder(folders("metaclip2"), "cpu")


def test_missing_image_statistics_are_not_guessed(folders, tmp_path):
    import shutil

    folder = shutil.copytree(folders("metaclip2"), tmp_path / "model")
    (folder / "preprocessor_config.json").unlink()
    with pytest.raises(UserError, match=r"preprocessor_config\.json"):
        load_image_text_encoder(folder, "cpu")
