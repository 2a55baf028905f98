"""Encoders: the real loading code on folders of tiny random models, against transformers itself."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from tiny_models import make_tiny_clip, make_tiny_dinov2

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.encoders import load_dense_encoder, load_image_text_encoder
from lang3dxl_ns.preparation.model_files import USUAL_CLIP, check_encoders, find_model, usual_clip
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.training.batches import settled

TEXTS = ["a rose window", "minaret", "the dome of a mosque, seen from far away in the evening light"]


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory):
    return make_tiny_clip(tmp_path_factory.mktemp("models") / "clip")


@pytest.fixture(scope="module")
def dino_folder(tmp_path_factory):
    return make_tiny_dinov2(tmp_path_factory.mktemp("models") / "dino")


@pytest.fixture(scope="module")
def clip(clip_folder):
    return load_image_text_encoder(str(clip_folder), "cpu")


def test_embeddings_are_not_normalized_and_can_meet_autograd(clip):
    crops = torch.rand(3, 3, 32, 32, generator=torch.manual_seed(1))
    embeddings = clip.encode_images(crops)
    assert (embeddings.norm(dim=-1) - 1).abs().min() > 0.05
    weight = torch.ones(64, requires_grad=True)
    (embeddings * weight).square().sum().backward()
    assert weight.grad is not None


def test_the_folders_own_statistics_are_used(clip, clip_folder, tmp_path):
    folder = shutil.copytree(clip_folder, tmp_path / "clip")
    settings = json.loads((folder / "preprocessor_config.json").read_text())
    settings["image_mean"] = [0.0, 0.0, 0.0]
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    other = load_image_text_encoder(folder, "cpu")
    crops = torch.rand(1, 3, 32, 32, generator=torch.manual_seed(1))
    assert (other.encode_images(crops) - clip.encode_images(crops)).abs().max() > 1e-3
    assert other.identity != clip.identity


def test_identity_follows_the_content_and_not_the_place(clip, clip_folder, tmp_path):
    moved = shutil.copytree(clip_folder, tmp_path / "elsewhere")
    assert find_model(moved, "--clip").clip_identity == clip.identity
    fine_tuned = make_tiny_clip(tmp_path / "fine-tuned", seed=1)
    assert find_model(fine_tuned, "--clip").clip_identity != clip.identity


def test_checkpoints_without_safetensors_load_too(clip, clip_folder, tmp_path):
    from transformers import CLIPModel

    folder = shutil.copytree(clip_folder, tmp_path / "clip")
    (folder / "model.safetensors").unlink()
    torch.save(CLIPModel.from_pretrained(clip_folder).state_dict(), folder / "pytorch_model.bin")
    crops = torch.rand(1, 3, 32, 32)
    torch.testing.assert_close(
        load_image_text_encoder(folder, "cpu").encode_images(crops), clip.encode_images(crops)
    )


def test_dense_features_are_the_patch_tokens_in_reading_order(dino_folder):
    from transformers import Dinov2Model

    encoder = load_dense_encoder(dino_folder, "cpu", tokens=6)
    photo = torch.rand(84, 84, 3, generator=torch.manual_seed(0))  # already 6 × 14 px: no resize
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    with torch.no_grad():
        output = Dinov2Model.from_pretrained(dino_folder)(((photo - mean) / std).permute(2, 0, 1)[None])
    features = encoder.encode(photo)
    assert features.shape == (6, 6, encoder.dim) == (6, 6, 32)
    torch.testing.assert_close(features.flatten(0, 1), output.last_hidden_state[0, 1:], rtol=1e-4, atol=1e-5)


def _dinov3():
    from transformers import DINOv3ViTConfig, DINOv3ViTModel

    width = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    return DINOv3ViTModel(DINOv3ViTConfig(**width, patch_size=16, image_size=64, num_register_tokens=4))


def _radio():
    from transformers import RadioConfig, RadioModel

    config = RadioConfig(hidden_size=32, num_hidden_layers=2, num_attention_heads=2, max_img_size=128)
    return RadioModel(config)


@pytest.mark.parametrize("make", [_dinov3, _radio])
@torch.no_grad()
def test_register_tokens_and_a_networks_own_normalization_are_heeded(make, tmp_path):
    torch.manual_seed(0)
    model = make().eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)  # some start at zero
    model.save_pretrained(tmp_path / "model")
    encoder = load_dense_encoder(tmp_path / "model", "cpu", tokens=5)
    photo = torch.rand(80, 80, 3, generator=torch.manual_seed(0))  # already 5 × 16 px: no resize
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    pixels = photo if make is _radio else (photo - mean) / std
    output = model(pixels.permute(2, 0, 1)[None])
    expected = output.features[0] if make is _radio else output.last_hidden_state[0, 1 + 4 :]
    torch.testing.assert_close(encoder.encode(photo).flatten(0, 1), expected, rtol=1e-4, atol=1e-5)


def test_dense_grid_keeps_top_left_at_the_top_left(dino_folder):
    encoder = load_dense_encoder(dino_folder, "cpu", tokens=4)
    plain = torch.full((100, 200, 3), 0.5)
    marked = plain.clone()
    marked[:25, :50] = torch.rand(25, 50, 3, generator=torch.manual_seed(0))
    change = (encoder.encode(marked) - encoder.encode(plain)).norm(dim=-1)
    assert change.argmax() == 0


def test_a_plain_vit_is_read_at_other_grids_than_its_own(tmp_path):
    from transformers import ViTConfig, ViTModel

    width = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    config = ViTConfig(**width, image_size=32, patch_size=8)
    ViTModel(config, add_pooling_layer=False).save_pretrained(tmp_path / "vit")
    encoder = load_dense_encoder(tmp_path / "vit", "cpu", tokens=7)
    assert encoder.encode(torch.rand(30, 40, 3)).shape == (7, 7, 16)


def test_the_builtin_models_are_read():
    encoder = load_image_text_encoder("builtin", "cpu")
    assert encoder.encode_texts(["dome", "rose windows"]).shape == (2, encoder.dim)
    assert load_dense_encoder("builtin", "cpu", tokens=8).encode(torch.rand(30, 40, 3)).shape[:2] == (8, 8)


def test_an_absent_model_is_an_error_that_names_it_and_the_remedy(tmp_path, monkeypatch):
    import huggingface_hub.constants

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(UserError, match=r"some-org/some-clip.*hf download .*--clip DIR"):
        load_image_text_encoder("some-org/some-clip", "cpu")
    with pytest.raises(UserError, match=r"--dense DIR"):
        load_dense_encoder("some-org/some-dino", "cpu")
    with pytest.raises(UserError, match="no/such/folder"):
        load_image_text_encoder("/no/such/folder", "cpu")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "config.json").unlink(), "config.json"),
        (lambda folder: (folder / "model.safetensors").unlink(), "safetensors"),
        (lambda folder: (folder / "model.safetensors").write_bytes(b"\0" * 100), "can't be loaded"),
        (lambda folder: (folder / "config.json").write_text("{"), "config.json"),
        (lambda folder: (folder / "tokenizer.json").unlink(), "tokenizer"),
    ],
)
def test_an_incomplete_clip_folder_is_an_error_that_names_what_is_missing(
    clip_folder, tmp_path, damage, message
):
    folder = shutil.copytree(clip_folder, tmp_path / "clip")
    damage(folder)
    with pytest.raises(UserError, match=message):
        load_image_text_encoder(folder, "cpu")


def test_weights_that_lack_tensors_are_refused_and_not_filled_at_random(clip_folder, tmp_path):
    from safetensors.torch import load_file, save_file

    folder = shutil.copytree(clip_folder, tmp_path / "clip")
    weights = load_file(folder / "model.safetensors")
    del weights["visual_projection.weight"]
    save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(UserError, match=r"lack 1 tensors.*visual_projection"):
        load_image_text_encoder(folder, "cpu")


def test_the_wrong_kind_of_model_is_refused(clip_folder, dino_folder):
    with pytest.raises(UserError, match="dinov2 model"):
        load_image_text_encoder(dino_folder, "cpu")
    with pytest.raises(UserError, match="without patch tokens"):
        load_dense_encoder(clip_folder, "cpu")


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_half_precision_on_the_gpu_stays_close_to_the_cpu(clip_folder, dino_folder):
    crops = torch.rand(8, 3, 32, 32)
    photo = torch.rand(60, 90, 3)
    for load, run in [
        (load_image_text_encoder, lambda encoder: encoder.encode_images(crops)),
        (load_image_text_encoder, lambda encoder: encoder.encode_texts(TEXTS)),
        (lambda _, device: load_dense_encoder(dino_folder, device, 8), lambda encoder: encoder.encode(photo)),
    ]:
        expected, found = run(load(clip_folder, "cpu")), run(load(clip_folder, "cuda"))
        assert found.dtype == torch.float32
        assert found.device.type == "cuda"
        assert (found.cpu() - expected).norm() < 0.01 * expected.norm()


@pytest.mark.parametrize(
    ("clip", "dense", "learned", "expected"),
    [
        ("builtin", "auto", True, "builtin"),
        ("openai/clip-vit-base-patch32", "auto", True, "facebook/dinov2-small"),
        ("builtin", "mine", True, "mine"),
        ("builtin", "auto", False, "none"),  # a head for patches reads the photos, so nothing is blurred
        ("openai/clip-vit-base-patch32", "auto", False, "facebook/dinov2-small"),
        ("none", "auto", True, "none"),
    ],
)
def test_the_built_in_clip_takes_the_built_in_dense_encoder_along(clip, dense, learned, expected):
    config = PreparationConfig(clip=clip, dense=dense)
    assert settled(config, learned, not learned).dense == expected


CLIP, DINO = "openai/clip-vit-base-patch32", "facebook/dinov2-small"


@pytest.mark.parametrize(
    ("clip", "told"),
    [
        (
            CLIP,
            rf"Either use .*: --clip builtin\. .*download {CLIP} .*--clip DIR/\S+ --dense DIR/dinov2-small$",
        ),
        ("builtin", rf"Either do without .*--dense none\. Or, .* hf download {DINO}"),
    ],
)
def test_whoever_is_offline_is_told_of_the_missing_encoders_and_of_two_ways_out(clip, told):
    with pytest.raises(UserError, match=told):
        check_encoders(clip, DINO)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ImportError("Using SOCKS proxy, but the 'socksio' package is not installed."), "socksio"),
        (OSError(28, "No space left on device"), "No space left on device"),
    ],
)
def test_why_a_model_cannot_be_downloaded_is_told(monkeypatch, error, reason):
    import huggingface_hub

    def fails(*_, **__):
        raise error

    monkeypatch.setattr(huggingface_hub, "snapshot_download", fails)
    with pytest.raises(UserError, match=rf"the download fails \(.*{reason}.*\)\. Either use"):
        check_encoders(CLIP, DINO)
    with pytest.raises(UserError, match=rf"can't be downloaded \(.*{reason}.*\)\. On a machine"):
        load_dense_encoder(DINO, "cpu")


def test_an_encoder_that_is_here_is_not_asked_for(tiny_clip):
    with pytest.raises(UserError) as told:
        check_encoders(str(tiny_clip), DINO)
    assert "openai" not in str(told.value)
    assert "--clip DIR" not in str(told.value)


def test_without_a_download_the_clip_is_the_built_in_one(monkeypatch, tmp_path):
    import huggingface_hub

    assert usual_clip("auto", "auto") == "builtin" and usual_clip("some/clip", "auto") == "some/clip"
    cached = {(model, n): str(tmp_path) for model in (USUAL_CLIP, DINO) for n in ("model.safetensors", "x")}
    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", lambda *file: cached.get(file))
    assert usual_clip("auto", "auto") == USUAL_CLIP
    del cached[DINO, "model.safetensors"]  # it would be downloaded
    assert usual_clip("auto", "auto") == "builtin" and usual_clip("auto", "none") == USUAL_CLIP
    del cached[USUAL_CLIP, "model.safetensors"]  # an interrupted download
    assert usual_clip("auto", "none") == "builtin"
