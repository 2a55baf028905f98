"""Photos in the light that an encoder knows: what it undoes, and what it leaves."""

import json
import shutil

import pytest
import torch
from PIL import Image

from lang3dxl_ns.preparation import kinds as module
from lang3dxl_ns.preparation.encoders import BUILTIN, in_known_light, load_image_text_encoder
from lang3dxl_ns.preparation.prepare import prepare
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.photo import Photo


@pytest.fixture
def photo():
    """A dark one: its mean is 0.35."""
    return 0.05 + 0.6 * torch.rand(40, 60, 3, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("tint", [(1, 1, 1), (0.6, 0.8, 1.0), (1.0, 0.7, 0.5)])
@pytest.mark.parametrize("darker", [0.3, 1.0])
def test_a_dark_tinted_photo_gets_the_brightness_and_loses_its_tint(photo, tint, darker):
    lit = in_known_light(photo * darker * torch.tensor(tint), 0.6)
    means = lit.mean((0, 1))
    assert (means - means.mean()).abs().max() < 0.03
    assert abs(float(means.mean()) - 0.6) < 0.06


def test_gamma_and_tint_of_a_camera_are_undone(photo):
    neutral = in_known_light(photo, 0.6)
    taken = (photo * torch.tensor([0.9, 1.0, 0.8])) ** 2.2
    as_taken = in_known_light(photo**2.2, 0.6)
    assert (in_known_light(taken, 0.6) - neutral).abs().mean() < 0.3 * (taken - photo).abs().mean()
    assert (as_taken - neutral).abs().max() < 0.1


def test_darker_pixels_stay_darker_in_every_channel(photo):
    lit = in_known_light(photo * torch.tensor([0.5, 0.6, 0.9]), 0.6)
    for channel in range(3):
        order = photo[..., channel].flatten().argsort()
        assert (lit[..., channel].flatten()[order].diff() >= 0).all()


def test_photos_as_bright_as_those_that_it_knows_stay_as_taken(photo):
    for factor in (1.3, 1.5):
        assert torch.equal(in_known_light(factor * photo, 0.6), factor * photo)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_black_and_white_stay_what_they_are(value):
    constant = torch.full((4, 5, 3), value)
    assert torch.equal(in_known_light(constant, 0.6), constant)


def test_only_an_encoder_that_asks_for_it_gets_another_light(tiny_clip, tmp_path, photo):
    assert torch.equal(load_image_text_encoder(tiny_clip, "cpu").in_known_light(photo), photo)
    builtin = load_image_text_encoder(BUILTIN, "cpu")
    assert torch.equal(builtin.in_known_light(photo), in_known_light(photo, 0.6))
    folder = shutil.copytree(tiny_clip, tmp_path / "clip")
    settings = json.loads((folder / "preprocessor_config.json").read_text())
    (folder / "preprocessor_config.json").write_text(json.dumps(settings | {"brightness": 0.5}))
    asks = load_image_text_encoder(folder, "cpu")
    assert torch.equal(asks.in_known_light(photo), in_known_light(photo, 0.5))
    assert asks.identity != load_image_text_encoder(tiny_clip, "cpu").identity  # targets are made anew


def test_targets_are_made_in_that_light(tmp_path, photo, monkeypatch):
    seen = []
    build = module.build_clip_target
    monkeypatch.setattr(
        module, "build_clip_target", lambda image, *rest: seen.append(image) or build(image, *rest)
    )
    taken = Photo("a.png", tmp_path / "a.png", None, Lens(60, 40, 50.0, 50.0, 30.0, 20.0))
    Image.new("RGB", (60, 40)).save(taken.path)
    dark = (0.3 * photo * 255).round().to(torch.uint8)
    monkeypatch.setattr(Photo, "read_uint8", lambda self, scale: dark)
    config = PreparationConfig(clip=BUILTIN, dense="none")
    prepare([taken], None, config, [0.5], FeatureStore(tmp_path / "store"), "cpu")
    torch.testing.assert_close(seen[0], in_known_light(dark / 255, 0.6))
