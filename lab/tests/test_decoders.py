"""Laws of the feature decoders that are trained with the scene, the baselines' among them."""

import pytest
import torch

from lab.baselines import langsplat
from lab.baselines.fmgs import neighbor_similarity, pixel_alignment_loss
from lang3dxl_ns.components.decoders import DECODERS, DecoderConfig, make_decoder
from lang3dxl_ns.components.field_settings import SemanticFieldConfig

NAMES = [name for name, kind in DECODERS.items() if not kind.needs_lifting]
CLIP, DENSE = 16, 6


def decoder_of(name: str):
    torch.manual_seed(0)
    return make_decoder(DecoderConfig(name), SemanticFieldConfig("short"), CLIP, DENSE)


def statistics():
    channels = torch.arange(CLIP + DENSE, dtype=torch.float32)
    return 1 + channels / 10, 0.5 + channels / 20


@pytest.mark.parametrize("name", NAMES)
def test_every_encoder_renders_some_width_and_decodes_to_the_widths_of_the_targets(name):
    decoder = decoder_of(name)
    gaussians = {"means": torch.randn(30, 3)}
    codes = decoder.initial_codes(30)
    if codes is not None:
        gaussians["codes"] = codes
    carried = decoder.carried(gaussians)
    clip, dense = decoder(carried.reshape(5, 6, -1))
    assert clip.shape == (5, 6, CLIP)
    torch.testing.assert_close(decoder.decode_clip(carried), clip.flatten(0, 1))
    assert dense is None if name == "langsplat" else dense.shape == (5, 6, DENSE)
    assert decoder.picture(carried.reshape(5, 6, -1)).shape == (5, 6, 3)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_reach_the_codes_and_everything_that_is_trained_and_nothing_else(name):
    decoder = decoder_of(name)
    means = torch.randn(30, 3, requires_grad=True)
    gaussians = {"means": means}
    codes = decoder.initial_codes(30)
    if codes is not None:
        gaussians["codes"] = codes.requires_grad_()
    if name in ("feature3dgs", "direct"):
        gaussians["codes"] = (
            codes.detach() + 0.1
        ).requires_grad_()  # they start at 0, where a square has no gradient
    clip, dense = decoder(decoder.carried(gaussians))
    (clip.square().sum() + (0 if dense is None else dense.square().sum())).backward()
    trained = [p for group in decoder.parameter_groups().values() for p in group]
    assert all(p.grad.abs().max() > 0 for p in trained)
    assert means.grad is None
    if codes is not None:
        assert gaussians["codes"].grad.abs().max() > 0
    others = [p for p in decoder.parameters() if not any(p is q for q in trained)]
    assert all(p.grad is None for p in others)


@pytest.mark.parametrize("name", ["feature3dgs", "direct"])
def test_training_starts_at_the_mean_of_the_targets(name):
    decoder = decoder_of(name)
    if name == "feature3dgs":
        torch.nn.init.zeros_(decoder.layer.bias)
    mean, std = statistics()
    decoder.set_output_statistics(mean, std)
    clip, dense = decoder(decoder.initial_codes(4))
    torch.testing.assert_close(clip, mean[:CLIP].expand(4, -1))
    torch.testing.assert_close(dense, mean[CLIP:].expand(4, -1))


def test_codes_of_feature3dgs_are_half_as_wide_as_clip():
    assert decoder_of("feature3dgs").initial_codes(2).shape == (2, CLIP // 2)


def test_fmgs_gives_gaussians_at_one_place_one_feature_and_others_other_features():
    decoder = decoder_of("fmgs")
    places = torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [4.0, 2.0, 3.0]])
    first, same, other = decoder.carried({"means": places})
    torch.testing.assert_close(first, same)
    assert not torch.allclose(first, other)
    decoder.set_extent(places[0], 5.0)  # the world's unit and origin change nothing
    moved = decoder_of("fmgs")
    moved.set_extent(10 * places[0] - 7, 50.0)
    near = decoder.carried({"means": places})
    torch.testing.assert_close(moved.carried({"means": 10 * places - 7}), near)


def test_alignment_is_nothing_where_clip_and_dense_features_have_the_same_edges():
    labels = torch.zeros(8, 9, dtype=torch.long)
    labels[:, 5:] = 1
    clip, dense = torch.eye(CLIP)[labels], 3 * torch.eye(DENSE)[labels + 2]
    assert pixel_alignment_loss(clip, dense) < 1e-6
    assert pixel_alignment_loss(clip, torch.eye(DENSE)[labels.flip(1)]) > 0.01


def test_neighbors_are_the_eight_around():
    features = torch.zeros(5, 5, 2)
    features[..., 0] = 1
    features[2, 2] = torch.tensor([0.0, 1.0])
    similarity = neighbor_similarity(features)
    assert (similarity[2, 2] == 0).all()
    assert (similarity == 0).sum() == 16  # the odd one, and once in each neighbor
    assert similarity.shape == (5, 5, 8)


def test_alignment_moves_clip_towards_dense_and_not_the_other_way():
    clip, dense = (torch.randn(6, 6, 4, requires_grad=True) for _ in range(2))
    pixel_alignment_loss(clip, dense).backward()
    assert clip.grad.abs().max() > 0
    assert dense.grad is None


def test_autoencoder_of_langsplat_tells_the_features_of_a_scene_apart(monkeypatch):
    monkeypatch.setattr(langsplat, "_STEPS", 120)
    generator = torch.Generator().manual_seed(0)
    prototypes = torch.randn(4, CLIP, generator=generator)
    targets = [4 * prototypes[torch.randint(4, (9, 8), generator=generator)] for _ in range(3)]
    decoder = decoder_of("langsplat")
    decoder.set_output_statistics(torch.zeros(CLIP + DENSE), torch.ones(CLIP + DENSE))
    decoder.learn_targets(lambda: iter(targets))
    codes = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=1)
    decoded = decoder.decode_clip(codes)
    similarity = torch.nn.functional.normalize(decoded, dim=1) @ torch.nn.functional.normalize(prototypes).T
    assert (similarity.amax(0) > 0.95).all()  # each of them is the decoding of some code
    torch.testing.assert_close(decoded.norm(dim=1), torch.full((2000,), CLIP**0.5))
    assert not any(p.requires_grad for p in decoder.parameters())


def test_gaussians_of_langsplat_carry_codes_of_unit_length():
    carried = decoder_of("langsplat").carried({"codes": 5 * torch.randn(20, 3)})
    torch.testing.assert_close(carried.norm(dim=1), torch.ones(20))
