"""Training of the small CLIP: exact resume, losses, and the shipped model's quality."""

import dataclasses

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from lab.clip_training import train_dense
from lab.clip_training.captions import ADJECTIVES, CANONICAL, CLASS, GENERIC, Caption
from lab.clip_training.contrastive import caption_fit, contrastive_loss
from lab.clip_training.teacher import score_teacher
from lab.clip_training.train_clip import ClipTraining, learning_rate, train
from lab.clip_training.views import render_landmark
from lab.landmark.labels import CATEGORIES, ELEMENT, PART, category_masks
from lab.landmark.materials import MATERIALS
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.encoders import load_dense_encoder, load_image_text_encoder


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Colored noise in place of rendered landmarks, for speed."""
    folder = tmp_path_factory.mktemp("cache")
    rng = np.random.default_rng(0)
    (folder / "train").mkdir()
    for seed, family in ((10_000, "mosque"), (10_001, "cathedral")):
        planes = np.zeros((2, 6, 60, 80), np.uint8)
        planes[:, :3] = rng.integers(0, 255, (2, 3, 60, 80))
        planes[:, 3, :, 20:60] = PART["dome"]
        planes[:, 4, 20:40, 30:50] = ELEMENT["window"]
        np.save(folder / "train" / f"{family}_{seed}.npy", planes)
    return folder


def settings(cache, out, **changes):
    config = ClipTraining(
        out=out, cache=cache, steps=20, batch=8, landmarks=2, render_processes=0, validation_landmarks=0
    )
    return dataclasses.replace(config, **changes)


@pytest.fixture(scope="module")
def trained(cache, tmp_path_factory):
    out = tmp_path_factory.mktemp("models") / "clip"
    train(settings(cache, out))
    return out


def test_an_interrupted_training_ends_with_the_same_weights(cache, trained, tmp_path):
    train(settings(cache, tmp_path / "clip", stop_after=7))
    assert not (tmp_path / "clip").exists()
    train(settings(cache, tmp_path / "clip", resume=True))
    weights, expected = (load_file(folder / "model.safetensors") for folder in (tmp_path / "clip", trained))
    assert weights.keys() == expected.keys()
    for name, tensor in expected.items():
        torch.testing.assert_close(weights[name], tensor, rtol=1e-4, atol=1e-5)


def test_a_checkpoint_of_another_model_is_refused(cache, tmp_path):
    (tmp_path / "train").symlink_to(cache / "train")
    torch.save({"model": {"weight": torch.zeros(1)}}, tmp_path / "checkpoint.pt")
    with pytest.raises(UserError, match="another model"):
        train(settings(tmp_path, tmp_path / "clip", resume=True))


def test_too_few_landmarks_are_an_error_without_rendering_processes(cache, tmp_path):
    with pytest.raises(UserError, match="holds 2 landmarks"):
        train(settings(cache, tmp_path / "clip", landmarks=3))


def test_training_without_time_ends_at_once_with_a_model(cache, tmp_path):
    train(settings(cache, tmp_path / "clip", minutes=0))
    assert (tmp_path / "clip" / "model.safetensors").exists()


def test_the_saved_folder_is_read_by_the_preparation(trained):
    encoder = load_image_text_encoder(trained, "cpu")
    assert encoder.encode_images(torch.rand(2, 3, 48, 48)).shape == (2, encoder.dim)
    assert encoder.encode_texts(["minarets", "a rose window, seen from far away"]).shape == (2, encoder.dim)
    assert (trained / "vocab.json").exists()
    assert (trained / "merges.txt").exists()


def test_categories_and_canonical_phrases_are_single_known_tokens(trained):
    from transformers import CLIPTokenizer

    tokenizer = CLIPTokenizer.from_pretrained(trained)
    for word in (*CATEGORIES, *CANONICAL):
        ids = tokenizer(word)["input_ids"]
        assert len(ids) == 3, word
        assert tokenizer.unk_token_id not in ids[1:-1], word
    odd = tokenizer("Zwiebeltürme & fenêtres 7")["input_ids"][1:-1]
    assert tokenizer.unk_token_id not in odd


def test_a_caption_fits_by_class_share_material_and_family():
    shares = np.zeros((2, GENERIC))
    shares[0, CLASS["dome"]], shares[1, CLASS["dome"]], shares[1, CLASS["wall"]] = 1.0, 0.4, 0.6
    materials = np.repeat([[MATERIALS.index("gold")], [MATERIALS.index("slate")]], GENERIC, axis=1)
    captions = [
        Caption("dome", CLASS["dome"]),
        Caption("golden dome", CLASS["dome"], adjective=ADJECTIVES.index("golden")),
        Caption("dome of a mosque", CLASS["dome"], family=1),
        Caption("things", GENERIC),
    ]
    fit = caption_fit(captions, shares, materials, np.array([1, 0]))
    np.testing.assert_allclose(fit[:, 0], [1.0, 0.4])
    np.testing.assert_allclose(fit[:, 1], [1.0, 0.4 * 0.3])
    np.testing.assert_allclose(fit[:, 2], [1.0, 0.4 * 0.3])
    assert fit[0, 3] == fit[1, 3] > 0


def test_the_loss_is_lowest_where_similarities_follow_the_fit():
    fit = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    classes = torch.tensor([0, 1])
    unit = torch.eye(2)
    right, wrong = (
        contrastive_loss(unit, texts, fit, classes, torch.tensor(10.0)) for texts in (unit, unit.flip(0))
    )
    assert right < 0.01
    assert wrong > 9


def test_a_class_with_many_captions_pulls_a_crop_no_more_than_one_with_a_single_caption():
    """The image→text half is least where the two classes, not the three captions, share the probability."""
    fit, classes = torch.tensor([[0.5, 0.5, 0.5]]), torch.tensor([0, 0, 1])
    image, scale = torch.tensor([[1.0, 0.0]]), torch.tensor(1.0)

    def loss(single):  # log probabilities of the captions; the text→image half is constant for a single crop
        logits = torch.tensor([(1 - single) / 2, (1 - single) / 2, single]).log()
        return float(contrastive_loss(image, torch.stack([logits, logits * 0], dim=1), fit, classes, scale))

    assert loss(0.5) < loss(1 / 3)
    assert loss(0.5) < loss(0.7)


def test_the_learning_rate_warms_up_and_falls_to_a_fiftieth():
    peak = learning_rate(60, 0.0)
    assert learning_rate(0, 0.0) < peak / 50
    assert learning_rate(500, 0.5) == pytest.approx(0.51 * peak)
    assert learning_rate(1_000, 1.0) == pytest.approx(0.02 * peak)


def test_a_dense_encoder_made_from_the_clip_reads_photos_at_any_grid(cache, trained, tmp_path):
    train_dense.train(train_dense.DenseTraining(clip=trained, out=tmp_path / "dense", cache=cache, steps=2))
    photo = torch.rand(60, 90, 3)
    for tokens in (4, 9):
        features = load_dense_encoder(tmp_path / "dense", "cpu", tokens).encode(photo)
        assert features.shape[:2] == (tokens, tokens)
        assert features.flatten(0, 1).std(0).min() > 0


@pytest.mark.slow
def test_the_shipped_model_finds_prompts_on_an_unseen_landmark(tmp_path):
    views = [np.load(render_landmark(tmp_path, seed, 1))[0] for seed in (0, 1)]
    score = score_teacher(load_image_text_encoder("builtin", "cpu"), views)
    chance = np.mean([[mask.mean() for mask in category_masks(view[3], view[4]).values()] for view in views])
    assert score.mean > max(0.3, 2 * chance)
