"""Laws of the semantic field."""

import dataclasses
import math

import pytest
import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.field_settings import PRESETS, SemanticFieldConfig
from lang3dxl_ns.components.semantic_field import SemanticField

# Every preset, at a size affordable in a test.
CONFIGS = {
    "short": {"preset": "short"},
    "paper": {"preset": "paper", "hidden_width": 32},
    "official": {"preset": "official", "log2_table_size": 12, "hidden_width": 32},
}


def make_field(name, clip_dim=512, dense_dim=8, seed=0, **overrides):
    config = SemanticFieldConfig(**{**CONFIGS[name], **overrides})
    return SemanticField(config, clip_dim, dense_dim, generator=torch.Generator().manual_seed(seed))


def make_codes(*shape, seed=1):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def parameters_on_paper(name):
    """Encoding and decoder parameter counts of a full preset, without allocating it."""
    with torch.device("meta"):
        field = SemanticField(SemanticFieldConfig(name), 512, 384)
    counts = [sum(p.numel() for p in group) for group in field.parameter_groups().values()]
    return field, counts


def test_official_preset_has_the_published_size():
    field, (encoding, decoder) = parameters_on_paper("official")
    assert field.grid.entries == 7_685_416
    assert encoding == 7_685_416 * 8  # 61.5 million
    assert field.grid.dense_levels == 2
    assert decoder == 2 * (512 * 512 + 512) + 512 * 896 + 896


def test_paper_preset_has_the_printed_size():
    field, (encoding, decoder) = parameters_on_paper("paper")
    assert encoding == 16 * 2**8 * 8
    assert field.grid.dense_levels == 0
    assert decoder == 3 * (512 * 512 + 512) + 512 * 896 + 896
    kinds = [type(layer).__name__ for layer in field.layers]
    assert kinds == ["Linear", "Linear", "Linear", "ReLU"]


def test_short_preset_puts_fourier_features_beside_eight_levels():
    field, _ = parameters_on_paper("short")
    assert field.layers[0].in_features == 3 + 3 * 2 * 4 + 8 * 4


def test_fourier_features_are_unit_circles_that_turn_once_to_eight_times():
    field = make_field("short")
    coordinates = torch.rand(7, 3, generator=torch.Generator().manual_seed(0))
    features = field._fourier(coordinates)
    assert torch.equal(features[:, :3], coordinates)
    waves = torch.complex(features[:, 15:], features[:, 3:15]).reshape(7, 3, 4)  # cosine + i sine
    for octave in range(4):
        turns = torch.polar(torch.ones(7, 3), 2 * math.pi * 2**octave * coordinates)
        torch.testing.assert_close(waves[:, :, octave], turns, atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", CONFIGS)
def test_shapes_follow_the_batch(name):
    field = make_field(name)
    for batch in [(5,), (2, 3), (2, 0)]:
        clip, dense = field(make_codes(*batch, 3))
        assert clip.shape == (*batch, 512)
        assert dense.shape == (*batch, 8)


@pytest.mark.parametrize("name", CONFIGS)
def test_decode_clip_equals_the_clip_part_of_forward(name):
    field, codes = make_field(name), make_codes(4, 5, 3)
    field.set_output_statistics(torch.rand(520), torch.rand(520))
    assert torch.equal(field.decode_clip(codes), field(codes)[0])


def test_without_a_dense_head_there_is_no_dense_output():
    field = make_field("short", dense_dim=0)
    clip, dense = field(make_codes(4, 3))
    assert clip.shape == (4, 512)
    assert dense is None


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("start", ["initial", "zero"])
def test_codes_have_a_gradient_at_the_start_and_at_exactly_zero(name, start):
    field = make_field(name)
    torch.manual_seed(0)
    codes = torch.zeros(6, 3) if start == "zero" else field.initial_codes(6)
    codes.requires_grad_()
    field.decode_clip(codes).abs().sum().backward()
    assert (codes.grad != 0).all()


@pytest.mark.parametrize("name", CONFIGS)
def test_far_codes_decode_to_finite_features(name):
    field = make_field(name)
    codes = torch.tensor([40.0, -40.0, 1e30, -1e30, math.inf, -math.inf])[:, None].expand(-1, 3).clone()
    codes.requires_grad_()
    clip, dense = field(codes)
    (clip.sum() + dense.sum()).backward()
    assert clip.isfinite().all()
    assert dense.isfinite().all()
    assert codes.grad.isfinite().all()
    assert all(p.grad.isfinite().all() for p in field.parameters())


@pytest.mark.parametrize("name", CONFIGS)
def test_a_nan_code_spoils_its_own_pixel_only(name):
    field, codes = make_field(name), make_codes(5, 3)
    clean = field.decode_clip(codes)
    codes[2, 0] = math.nan
    spoilt = field.decode_clip(codes)
    keep = torch.arange(5) != 2
    assert spoilt[2].isnan().all()
    assert torch.equal(spoilt[keep], clean[keep])


def test_raw_coordinates_are_the_codes_and_negative_ones_learn():
    field = make_field("official")
    codes = torch.full((1, 3), -0.4, requires_grad=True)
    assert torch.equal(field._coordinates(codes), codes)
    field.decode_clip(codes).sum().backward()
    assert (codes.grad != 0).all()


def test_four_index_passes_make_512_channels_that_do_not_share_coarse_entries():
    field = make_field(
        "official", log2_table_size=16
    )  # 16⁴ entries: the coarsest level is dense, as published
    coordinates = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    encoding = field._read_grid(coordinates)
    assert encoding.shape == (50, 512)
    coarsest = field.grid.offsets[1]
    touched = []
    for one_pass in encoding.split(128, dim=1):
        (gradient,) = torch.autograd.grad(one_pass.sum(), field.grid.table, retain_graph=True)
        touched.append(gradient[:coarsest].abs().sum(1) > 0)
    assert all(entries.any() for entries in touched)
    assert torch.stack(touched).sum(0).max() == 1


def test_index_passes_continue_until_there_are_as_many_channels_as_clip_has():
    field = make_field("paper", clip_dim=300)
    assert field._read_grid(torch.rand(2, 3)).shape == (2, 300)


def test_whitened_output_of_a_silent_network_is_the_mean():
    field = make_field("short", clip_dim=6, dense_dim=4)
    mean, std = torch.linspace(-3, 3, 10), torch.linspace(0, 2, 10)
    field.set_output_statistics(mean, std)
    with torch.no_grad():
        field.output.weight.zero_()
        field.output.bias.zero_()
    clip, dense = field(make_codes(3, 3))
    assert torch.equal(torch.cat((clip, dense), 1), mean.expand(3, 10))


def test_whitening_is_mean_plus_deviation_times_network():
    field, codes = make_field("short", clip_dim=6, dense_dim=4), make_codes(7, 3)
    plain = torch.cat(field(codes), 1)
    mean, std = torch.linspace(-3, 3, 10), torch.linspace(0, 2, 10)
    field.set_output_statistics(mean, std)
    torch.testing.assert_close(torch.cat(field(codes), 1), mean + std * plain)


def test_parity_presets_are_not_whitened():
    for name in ("paper", "official"):
        field, codes = make_field(name), make_codes(3, 3)
        before = field.decode_clip(codes)
        field.set_output_statistics(torch.ones(520), 2 * torch.ones(520))
        assert torch.equal(field.decode_clip(codes), before)


def test_unusable_statistics_are_refused():
    field = make_field("short", clip_dim=6, dense_dim=4)
    with pytest.raises(ValueError, match="10 channels"):
        field.set_output_statistics(torch.zeros(6), torch.ones(6))
    for mean, std in [(math.nan, 1.0), (0.0, math.inf), (0.0, -1.0)]:
        with pytest.raises(ValueError, match="finite"):
            field.set_output_statistics(torch.full((10,), mean), torch.full((10,), std))


@pytest.mark.parametrize("name", CONFIGS)
def test_a_restored_field_decodes_as_the_saved_one(name):
    field, codes = make_field(name), make_codes(9, 3)
    field.set_output_statistics(torch.rand(520), torch.rand(520))
    restored = make_field(name, seed=5)
    restored.load_state_dict(field.state_dict())
    for ours, theirs in zip(restored(codes), field(codes), strict=True):
        assert torch.equal(ours, theirs)


def test_float64_fields_compute_in_float64():
    field, codes = make_field("short"), make_codes(4, 3)
    single = field.decode_clip(codes)
    double = field.double().decode_clip(codes.double())
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single)


def test_parameter_groups_hold_every_parameter_once():
    field = make_field("short")
    grouped = [*field.parameter_groups()["field_encoding"], *field.parameter_groups()["field_decoder"]]
    assert len({id(p) for p in grouped}) == len(grouped)
    assert {id(p) for p in grouped} == {id(p) for p in field.parameters()}


def test_one_seed_gives_one_field_and_leaves_the_global_generator_alone():
    state = torch.get_rng_state()
    first, again, other = make_field("short"), make_field("short"), make_field("short", seed=1)
    assert torch.equal(torch.get_rng_state(), state)
    codes = make_codes(3, 3)
    assert torch.equal(first.decode_clip(codes), again.decode_clip(codes))
    assert not torch.equal(first.decode_clip(codes), other.decode_clip(codes))


def test_initial_codes_are_small_noise_and_exact_zeros_for_the_official_preset():
    torch.manual_seed(0)
    codes = make_field("paper").initial_codes(4000)
    assert codes.shape == (4000, 3)
    assert abs(codes.std().item() - 0.01) < 5e-4
    assert abs(codes.mean().item()) < 5e-4
    assert not make_field("official").initial_codes(10).any()


def test_a_setting_wins_over_its_preset():
    assert SemanticFieldConfig("short", levels=5).resolved() == dataclasses.replace(
        PRESETS["short"], levels=5
    )


@pytest.mark.parametrize("name", ["auto", *PRESETS])
def test_resolved_settings_are_complete_and_resolve_to_themselves(name):
    settings = SemanticFieldConfig(name).resolved()
    assert None not in dataclasses.astuple(settings)
    assert settings.resolved() == settings


def test_wrong_settings_are_explained():
    with pytest.raises(UserError, match="choose one of auto, short, paper, official"):
        SemanticFieldConfig("large").resolved()
    with pytest.raises(UserError, match="2 to 5"):
        SemanticFieldConfig("official", code_dim=6).resolved()
    with pytest.raises(UserError, match="2 to 6"):
        SemanticFieldConfig("short", code_dim=7).resolved()
    with pytest.raises(UserError, match="fourier_frequencies"):
        SemanticFieldConfig("short", levels=0, fourier_frequencies=0).resolved()
    with pytest.raises(UserError, match="at least one"):
        SemanticFieldConfig("short", hidden_layers=0).resolved()


def test_the_config_can_be_set_on_a_command_line():
    tyro = pytest.importorskip("tyro")
    config = tyro.cli(SemanticFieldConfig, args=["--preset", "short", "--levels", "4", "--whiten", "False"])
    assert config == SemanticFieldConfig("short", levels=4, whiten=False)


def test_short_preset_learns_a_labeled_scene_in_300_steps():
    """Codes and field together: 400 codes move to where they decode to their class' features."""
    generator = torch.Generator().manual_seed(0)
    prototypes = 1 + 0.5 * torch.randn(12, 24, generator=generator)
    targets = prototypes[torch.randint(12, (400,), generator=generator)]
    field = make_field("short", clip_dim=16, log2_table_size=9)
    field.set_output_statistics(targets.mean(0), targets.std(0))
    codes = (0.01 * torch.randn(400, 3, generator=generator)).requires_grad_()
    groups = [
        {"params": [codes], "lr": 3e-2},
        {"params": field.parameter_groups()["field_encoding"], "lr": 1e-2},
        {"params": field.parameter_groups()["field_decoder"], "lr": 1e-2, "weight_decay": 1e-5},
    ]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 300)
    for _ in range(300):
        batch = torch.randint(400, (128,), generator=generator)
        loss = (torch.cat(field(codes[batch]), 1) - targets[batch]).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    error = (torch.cat(field(codes), 1) - targets).abs().mean()
    assert error < 0.15 * (targets - targets.mean(0)).abs().mean()


def test_fourier_features_alone_decode_and_teach_the_codes():
    field = make_field("short", levels=0)
    codes = make_codes(5, 3).requires_grad_()
    field(codes)[0].square().sum().backward()
    assert codes.grad.abs().max() > 0


def test_a_picture_has_three_channels_whatever_the_code():
    for code_dim in (2, 3, 4, 6):
        field, codes = make_field("short", code_dim=code_dim), make_codes(2, 2, code_dim)
        picture = field.picture(codes)
        assert picture.shape == (2, 2, 3) and field.decode_clip(codes).shape == (2, 2, 512)
        assert picture.min() >= 0 and picture.max() <= 1
