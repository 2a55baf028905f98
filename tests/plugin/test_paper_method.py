"""`ns-train lang3dxl-paper`: the paper's settings, and what they train."""

from copy import deepcopy

import pytest
import torch
from runs import train_run

import lab.baselines  # noqa: F401, which registers fmgs
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.methods import METHODS, lang3dxl_paper
from lang3dxl_ns.plugin import trainer as trainer_module

ITERATIONS = 70_000


@pytest.fixture(scope="module")
def fitted():
    """The configuration as a run of the published length has it."""
    config = deepcopy(lang3dxl_paper.config)
    config.max_num_iterations = ITERATIONS
    config.fit_to_run()
    return config


def rate(config, group, step):
    """Learning rate of a group at a step."""
    optimizer, scheduler = (config.optimizers[group][part] for part in ("optimizer", "scheduler"))
    return optimizer.lr * (1.0 if scheduler is None else scheduler.multiple(step))


@pytest.mark.parametrize(
    ("group", "step", "expected"),
    [
        ("means", 0, 1.6e-5 * 1.1),
        ("means", 30_000, 1.6e-7 * 1.1),
        ("means", 70_000, 1.6e-7 * 1.1),
        ("opacities", 70_000, 0.05),
        ("scales", 0, 5e-3),
        ("quats", 0, 1e-3),
        ("codes", 0, 1e-3),
        ("codes", 70_000, 1e-5),
        *((group, 0, 5e-5) for group in ("field_encoding", "field_decoder", "downsampler", "appearance")),
        *((group, 35_000, 5e-4) for group in ("field_encoding", "field_decoder", "downsampler")),
        ("field_decoder", 70_000, 5e-6),
        ("appearance", 21_000, 5e-4),
        ("appearance", 70_000, 5e-5),
        ("appearance_vectors", 0, 1e-3),
        ("appearance_vectors", 70_000, 1e-4),
    ],
)
def test_rates_are_the_published_ones(fitted, group, step, expected):
    assert rate(fitted, group, step) == pytest.approx(expected, rel=1e-3)


def test_weights_sizes_and_schedules_are_the_published_ones(fitted):
    model, data = fitted.pipeline.model, fitted.pipeline.datamanager
    field = model.semantic_field.resolved()
    assert (field.code_dim, field.indexed, field.levels, field.log2_table_size) == (3, True, 16, 8)
    assert (field.min_resolution, field.max_resolution, field.hidden_width) == (16, 2048, 512)
    assert (model.downsampler.kernel, model.downsampler.hidden) == ("box", 512)
    assert (model.clip_weight, model.dense_weight, model.ssim_lambda) == (1.0, 0.5, 0.5)
    assert model.decode_size == (80, 120) and model.densify_grad_thresh == pytest.approx(2e-4)
    steps = [ITERATIONS * x for x in (model.densify_from, model.densify_until, model.semantic_ramp)]
    assert steps == pytest.approx([2_000, 15_000, 15_000])
    for group in ("field_decoder", "downsampler"):
        assert fitted.optimizers[group]["optimizer"].weight_decay == 1e-5
    assert (data.crops, data.regions, data.scale_mode) == ("pyramid", "sam", "physical")


@pytest.mark.parametrize(
    ("iterations", "decoder", "preset"),
    [(4_999, "paper", "short"), (5_000, "paper", "paper"), (5_000, "fmgs", "paper")],
)
def test_the_field_is_as_printed_in_runs_that_are_long_enough_for_it(iterations, decoder, preset, capsys):
    config = deepcopy(lang3dxl_paper.config)
    config.max_num_iterations, config.pipeline.model.decoder.name = iterations, decoder
    config.fit_to_run()
    assert config.pipeline.model.semantic_field.preset == preset
    assert (f"preset {preset}" in capsys.readouterr().out) == (decoder == "paper")


@pytest.mark.parametrize(
    ("iterations", "start", "warm_up", "crops", "grid"),
    [
        (4_999, "photos", 0.25, "fine", "coarse"),
        (5_000, "noise", 0.0, "pyramid", "paper"),
        (ITERATIONS, "noise", 0.0, "pyramid", "paper"),
    ],
)
def test_codes_start_crops_and_looks_are_as_printed_in_runs_that_are_long_enough(
    iterations, start, warm_up, crops, grid
):
    config = deepcopy(lang3dxl_paper.config)
    config.max_num_iterations = iterations
    config.fit_to_run()
    model = config.pipeline.model
    assert (model.codes_from, model.warm_up, model.appearance.preset) == (start, warm_up, grid)
    assert config.pipeline.datamanager.crops == crops


def test_codes_start_from_photos_only_where_the_decoder_can_learn_them():
    config = deepcopy(lang3dxl_paper.config)
    config.max_num_iterations, config.pipeline.model.decoder.name = 600, "direct"
    config.fit_to_run()
    assert config.pipeline.model.codes_from == "noise"
    config.pipeline.model.codes_from = "photos"
    with pytest.raises(UserError, match="codes of the decoder direct can't start from photos"):
        config.fit_to_run()


@pytest.mark.parametrize(("iterations", "sides"), [(600, (56, 72)), (30_000, (80, 120))])
def test_short_runs_decode_smaller_maps(iterations, sides):
    config = deepcopy(lang3dxl_paper.config)
    config.max_num_iterations = iterations
    config.fit_to_run()
    assert config.pipeline.model.decode_size == sides


def test_the_default_is_another_method_with_settings_of_its_own():
    default = METHODS["lang3dxl"].config
    assert default.method_name == "lang3dxl" and lang3dxl_paper.config.method_name == "lang3dxl-paper"
    assert default.pipeline.model.decoder.name != "paper"
    assert default.optimizers["codes"]["scheduler"].end == 0.05


@pytest.fixture(scope="module")
def trained(scene, tiny_clip, tiny_dense, tmp_path_factory):
    """A short run, with regions of one color in place of SAM's."""
    changes = {"pipeline__datamanager__regions": "felzenszwalb", "pipeline__model__downsampler__hidden": 16}
    folder = tmp_path_factory.mktemp("paper")
    return train_run(scene, tiny_clip, tiny_dense, folder, 4, method="lang3dxl-paper", **changes)


def test_mixed_precision_trains_in_bfloat16_on_a_cpu_that_multiplies_it(
    scene, tiny_clip, tiny_dense, tmp_path, monkeypatch
):
    def losses(multiplies: bool, **changes) -> torch.Tensor:
        monkeypatch.setattr(trainer_module, "multiplies_bfloat16", lambda: multiplies)
        changes |= {"pipeline__datamanager__regions": "none", "pipeline__model__downsampler__hidden": 16}
        trainer = train_run(scene, tiny_clip, tiny_dense, tmp_path, 2, method="lang3dxl-paper", **changes)
        assert not trainer.grad_scaler.is_enabled()
        return torch.stack([trainer.pipeline.last_losses[name] for name in ("rgb", "clip", "dense")]).detach()

    exact, mixed = losses(False), losses(True, mixed_precision=True)
    assert (mixed != exact)[1:].all()
    assert torch.allclose(mixed, exact, rtol=0.1)  # one step of Adam enlarges what rounding leaves
    with pytest.raises(UserError, match="does not multiply bfloat16"):
        losses(False, mixed_precision=True)


def test_every_loss_of_the_paper_is_part_of_a_step(trained):
    losses = trained.pipeline.last_losses
    assert set(losses) == {"rgb", "clip", "dense", "regions"}
    assert all(torch.isfinite(value) and value > 0 for value in losses.values())


def test_semantic_losses_move_gaussians_and_leave_opacities_to_the_colors(trained):
    model = trained.pipeline.model.train()
    model.zero_grad()
    camera, _ = trained.pipeline.datamanager.next_train(0)
    model.get_outputs(camera)["codes"].square().sum().backward()
    gradients = {name: value.grad for name, value in model.gauss_params.items()}
    assert gradients["means"].abs().max() > 0 and gradients["scales"].abs().max() > 0
    assert gradients["opacities"] is None or not gradients["opacities"].any()


def test_the_dense_loss_is_compared_at_its_target_and_sees_what_the_mask_leaves_out(trained, monkeypatch):
    from lang3dxl_ns.components import losses

    seen = []

    def dense_loss(prediction, target):
        seen.append(target)
        return prediction.sum() * 0

    monkeypatch.setattr(losses, "dense_loss", dense_loss)
    model, data = trained.pipeline.model.train(), trained.pipeline.datamanager
    camera, batch = data.next_train(0)
    batch["mask"] = torch.ones(*batch["image"].shape[:2], 1, dtype=torch.bool)
    model.get_loss_dict(model.get_outputs(camera), batch)
    assert len(seen) == 1 and seen[0] is batch["dense_target"]


def test_a_run_has_words_at_its_last_iteration_and_reads_as_this_method(trained):
    assert not trained.pipeline.model.run.learns_words_at_the_end
    assert trained.base_dir.parent.name == "lang3dxl-paper"
    assert list(trained.base_dir.glob("*.scene"))
