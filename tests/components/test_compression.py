"""Laws of compressing features on Gaussians to a few numbers each."""

from dataclasses import replace
from functools import partial

import pytest
import torch
import torch.nn.functional as F
from numerics.compression import compress

from lang3dxl_ns.components import compression
from lang3dxl_ns.components.compression import CompressedField, JointField, centered_cosine, draw_sample, fit
from lang3dxl_ns.components.feature_decoder import Gathered
from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig
from lang3dxl_ns.components.principal_basis import PrincipalBasis
from lang3dxl_ns.components.semantic_field import SemanticField
from lang3dxl_ns.training.learn_codes import TargetView, learn_codes

CHANNELS = 24
QUICK = CompressionConfig(steps=150, batch=512)
FEW = CompressionConfig(steps=20, batch=256)
"""Enough for what is equal after any number of steps."""


def field() -> SemanticField:
    return SemanticField(SemanticFieldConfig("short"), CHANNELS, generator=torch.Generator().manual_seed(0))


def clusters(sizes, spread=0.05, seed=0):
    """Features around as many centers, and the center that each belongs to."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.randn(len(sizes), CHANNELS, generator=generator)
    owner = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    noise = spread * torch.randn(len(owner), CHANNELS, generator=generator)
    return centers[owner] + noise, owner


def everything(features, basis=None):
    """Features of Gaussians that all fill a pixel."""
    return Gathered(features, torch.ones(len(features)), basis)


def compressed(features, mass, config=QUICK):
    trained = field()
    codes = compress(features, mass, trained, config, torch.Generator().manual_seed(0))
    return codes, trained


def agreement(features, codes, trained):
    with torch.no_grad():
        return F.cosine_similarity(trained.decode_clip(codes), features, dim=1)


@pytest.fixture(scope="module")
def eight():
    """Features of eight kinds, their codes, and the field that decodes them."""
    features, _ = clusters([300] * 8)
    return features, *compressed(features, torch.ones(len(features)))


def test_features_come_back(eight):
    features, codes, trained = eight
    assert codes.shape == (len(features), 3)
    assert agreement(features, codes, trained).mean() > 0.98


def test_a_class_of_half_a_percent_survives_beside_walls_of_great_mass():
    features, owner = clusters([1500, 800, 400, 285, 15])
    mass = torch.where(owner == 4, 2.0, 200.0)
    codes, trained = compressed(features, mass, replace(QUICK, steps=300))
    cosines = agreement(features, codes, trained)
    assert cosines[owner == 4].mean() > 0.9
    # And it is told from every other class.
    centers = torch.stack([features[owner == i].mean(0) for i in range(5)])
    with torch.no_grad():
        found = F.normalize(trained.decode_clip(codes[owner == 4]), dim=1) @ F.normalize(centers, dim=1).T
    assert (found.argmax(1) == 4).all()


def test_codes_fitted_to_blends_decode_a_mixture_of_two_to_the_mixture_of_their_features(eight):
    """The paper composites codes before it decodes them; codes fitted one by one decode to something else."""
    features, *plain = eight
    blended = field()
    others = fit(everything(features), blended, QUICK, torch.Generator().manual_seed(0), blends=0.9)
    generator = torch.Generator().manual_seed(1)
    a, b = (torch.randint(len(features), (4_000,), generator=generator) for _ in range(2))
    share = torch.rand(4_000, 1, generator=generator)
    found = []
    for codes, trained in (plain, (others, blended)):
        alone = agreement(features, codes, trained).mean()
        mixed = agreement(features[a].lerp(features[b], share), codes[a].lerp(codes[b], share), trained)
        found.append((float(alone), float(mixed.mean())))
    (alone, scattered), (still_alone, mixed) = found
    assert mixed > scattered + 0.05 and still_alone > 0.9 * alone


def test_what_no_photo_shows_stays_unknown_and_changes_nothing():
    features, _ = clusters([200] * 4)
    mass = torch.ones(len(features))
    alone, _ = compressed(features, mass, FEW)
    more = torch.cat([features, torch.full((5, CHANNELS), 1e6)])
    codes, _ = compressed(more, F.pad(mass, (0, 5)), FEW)
    assert codes[-5:].isnan().all()
    assert torch.equal(codes[:-5], alone)


def test_equal_features_have_codes_that_say_the_same():
    features, owner = clusters([400, 400, 400], spread=0.0)
    codes, trained = compressed(features, torch.ones(len(features)))
    with torch.no_grad():
        decoded = trained.decode_clip(codes)
    for i in range(3):
        assert decoded[owner == i].std(0).max() < 0.1 * decoded.std(0).max()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_gaussians_or_one_material_are_no_trouble(count):
    features = torch.ones(count, CHANNELS)
    codes, trained = compressed(features, torch.ones(count), FEW)
    assert codes.isfinite().all()
    torch.testing.assert_close(trained.decode_clip(codes).detach(), features, atol=1e-2, rtol=0)


def test_a_scene_that_nobody_has_seen_is_unknown():
    codes, _ = compressed(torch.zeros(4, CHANNELS), torch.zeros(4))
    assert codes.shape == (4, 3) and codes.isnan().all()


def test_learning_again_begins_anew():
    """As the viewer does while a run goes on, with Gaussians that have come meanwhile."""
    features, _ = clusters([200] * 4)
    decoder = CompressedField(SemanticFieldConfig("short"), CHANNELS, FEW)
    first = decoder.learn_gaussians(everything(features))
    decoder.learn_gaussians(everything(features.flip(0)[:300]))
    again = decoder.learn_gaussians(everything(features))
    assert torch.equal(first, again)


def test_coordinates_in_a_basis_compress_like_the_features(eight):
    features, whole, expected = eight
    mass = torch.ones(len(features))
    basis = PrincipalBasis.of([features], 10)
    trained = field()
    coordinates = basis.coordinates(features)
    codes = compress(coordinates, mass, trained, QUICK, torch.Generator().manual_seed(0), basis=basis)
    assert agreement(features, codes, trained).mean() > 0.98
    torch.testing.assert_close(trained.output_mean, expected.output_mean)
    # All variance lies in the basis but for the noise of 14 channels.
    torch.testing.assert_close(trained.output_std, expected.output_std, atol=0.02, rtol=0.02)
    assert agreement(features, whole, expected).mean() - agreement(features, codes, trained).mean() < 0.005


def test_many_times_as_many_gaussians_are_compressed_as_well():
    """The work grows with them; the field is trained on a sample."""
    found = []
    for sizes in ([20] * 8, [500] * 8):
        features, _ = clusters(sizes)
        codes, trained = compressed(
            features, torch.ones(len(features)), CompressionConfig(150, 512, sample=160)
        )
        found.append(centered_cosine(everything(features), trained, codes))
    assert found[0] > 0.95 and found[1] > found[0] - 0.02


@pytest.mark.parametrize(("count", "factor"), [(1, 1), (64, 1), (4 * 64, 2), (9 * 64, 3), (10**6, 3)])
def test_work_grows_with_the_gaussians_within_limits(count, factor):
    config = CompressionConfig(steps=10, batch=8, sample=64)
    grown = config.grown(count)
    assert (grown.steps, grown.sample, grown.batch) == (factor * 10, factor * 64, 8)


def test_every_step_of_many_gaussians_or_few_advances_the_bar():
    advanced = []
    for count in (64, 9 * 64):
        features, _ = clusters([count // 4] * 4)
        decoder = CompressedField(
            SemanticFieldConfig("short", code_dim=3), CHANNELS, CompressionConfig(100, 64, sample=64)
        )
        decoder.learn_gaussians(everything(features), partial(advanced.append, count))
        assert advanced.count(count) == decoder.learning_steps(count)
    assert CompressedField(SemanticFieldConfig("short"), CHANNELS).learning_seconds(10**6) > 180


def test_the_centered_cosine_sees_what_the_cosine_does_not():
    """Features that hardly differ from their mean, decoded to the mean."""
    features = 10 + 0.1 * torch.randn(200, CHANNELS, generator=torch.Generator().manual_seed(0))
    trained, codes = field(), torch.zeros(200, 3)
    trained.set_output_statistics(features.mean(0), torch.full((CHANNELS,), 1e-6))
    assert agreement(features, codes, trained).mean() > 0.999
    assert abs(centered_cosine(everything(features), trained, codes)) < 0.1
    mean, std = features.mean(0), features.std(0)
    basis = PrincipalBasis.of([features], CHANNELS)
    trained.set_output_statistics(mean, std)
    whole = centered_cosine(everything(features), trained, codes)
    assert centered_cosine(everything(basis.coordinates(features), basis), trained, codes) == pytest.approx(
        whole, abs=1e-3
    )


def test_a_sample_has_what_has_little_mass_more_often_than_its_mass():
    mass = torch.cat([torch.full((900,), 100.0), torch.full((100,), 1.0)])
    drawn = draw_sample(Gathered(torch.arange(1000.0)[:, None], mass), 200, torch.Generator().manual_seed(0))
    rows = drawn.features[:, 0].long()
    assert len(rows.unique()) == 200 and torch.equal(drawn.mass, mass[rows])
    assert 0 < (rows >= 900).sum() < 10  # by √mass two of 200 are expected, by mass none, by number 20


def test_codes_have_more_numbers_where_three_lose_too_much(monkeypatch):
    features, _ = clusters([100] * 4)
    losses = iter([0.9, 0.97, 0.97])
    monkeypatch.setattr(compression, "centered_cosine", lambda *_: next(losses))
    decoder = CompressedField(SemanticFieldConfig("short"), CHANNELS, CompressionConfig(20, 128))
    codes = decoder.learn_gaussians(everything(features))
    assert codes.shape[1] == decoder.code_dim == 4
    assert (
        decoder.learned is not None
        and "4 numbers" in decoder.learned
        and "3 numbers: 0.900" in decoder.learned
    )
    # Another process makes room for them, and decodes the same.
    other = CompressedField(SemanticFieldConfig("short"), CHANNELS)
    other.fit_codes(codes)
    other.load_state_dict(decoder.state_dict())
    torch.testing.assert_close(other.decode_clip(codes), decoder.decode_clip(codes))


def test_a_number_of_numbers_that_was_asked_for_is_kept(monkeypatch):
    features, _ = clusters([100] * 4)
    monkeypatch.setattr(compression, "centered_cosine", lambda *_: 0.0)
    config = SemanticFieldConfig("short", code_dim=2)
    decoder = CompressedField(config, CHANNELS, CompressionConfig(20, 128))
    assert decoder.learn_gaussians(everything(features)).shape[1] == 2


def test_codes_are_learned_in_full_precision_in_the_middle_of_a_mixed_precision_step():
    """A step's autocast keeps 16-bit copies of the first weights, which an optimizer would not change."""
    features, _ = clusters([48] * 4)
    maps = features.view(12, 16, CHANNELS)
    view = TargetView(lambda values: values.view(12, 16, -1), (12, 16), maps)
    found = []
    for enabled in (False, True):
        torch.manual_seed(0)
        decoder = JointField(SemanticFieldConfig("short"), CHANNELS, FEW)
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            codes = learn_codes(decoder, [view], 1, torch.zeros(len(features), 3), lambda: [maps])
        found.append((codes, decoder.decode_clip(codes)))
    torch.testing.assert_close(found[0], found[1])
