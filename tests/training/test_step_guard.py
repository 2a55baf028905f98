"""The step guard: steps that are not finite are skipped, counted and named; many stop the run."""

import math

import pytest
import torch
from runs import all_finite

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.training import batches
from lang3dxl_ns.training.step_guard import StepGuard


def group(gradient: float) -> dict[str, list[torch.Tensor]]:
    parameter = torch.zeros(3, requires_grad=True)
    parameter.grad = torch.tensor([0.0, gradient, 1.0])
    return {"means": [parameter], "unused": [torch.zeros(2, requires_grad=True)]}


FINE = {"rgb": torch.tensor(0.5)}


@pytest.mark.parametrize("gradient", [math.nan, math.inf, -math.inf, 1e25])
def test_a_broken_gradient_is_refused_and_named(gradient):
    lines = []
    guard = StepGuard(5, lines.append)
    assert not guard.allows(7, "a.jpg", FINE, group(gradient))
    assert lines == ["Step 7 is skipped: photo a.jpg gives no finite gradient of means"]
    assert guard.allows(8, "a.jpg", FINE, group(1e6))
    assert guard.skipped == 1


@pytest.mark.parametrize("loss", [math.nan, math.inf])
def test_a_broken_loss_is_refused_although_its_gradient_is_finite(loss):
    lines = []
    guard = StepGuard(5, lines.append)
    assert not guard.allows(0, "a.jpg", FINE | {"clip": torch.tensor(loss)}, group(0.0))
    assert "loss clip" in lines[0]
    assert "rgb" not in lines[0]


def test_only_steps_in_a_row_stop_the_run_and_a_photo_is_named_once():
    lines = []
    guard = StepGuard(3, lines.append)
    for _ in range(4):
        assert not guard.allows(0, "a.jpg", FINE, group(math.nan))
        assert not guard.allows(1, "a.jpg", FINE, group(math.nan))
        assert guard.allows(2, "b.jpg", FINE, group(1.0))
    assert len(lines) == 1
    assert "8 steps were skipped, most often at a.jpg (8)" in guard.summary()
    for step in range(2):
        guard.allows(step, "a.jpg", FINE, group(math.nan))
    with pytest.raises(UserError, match=r"3 steps in a row .* photo a\.jpg: gradient of means"):
        guard.allows(2, "a.jpg", FINE, group(math.nan))


CODES = {"pipeline__model__decoder__name": "paper"}


def spoil(monkeypatch, key: str, value: float, photos: set[str]) -> None:
    """Give the batches of these photos (empty: of all) a broken tensor."""
    make = batches.to_batch

    def spoiled(data, name, *how):
        batch = make(data, name, *how)
        if name in photos or not photos:
            batch[key] = torch.full(batch[key].shape, value)
        return batch

    monkeypatch.setattr(batches, "to_batch", spoiled)


@pytest.mark.parametrize("key", ["image", "clip_target"])
def test_a_photo_with_a_broken_target_leaves_no_trace_in_the_checkpoint(train, scene, monkeypatch, key):
    spoil(monkeypatch, key, math.nan, {"photo_001.jpg", "photo_002.jpg"})
    options = {"pipeline__model__densify_grad_thresh": 1e-7, "steps_per_eval_image": 0, **CODES}
    trainer = train(scene, iterations=30, **options)
    assert 4 <= trainer.guard.skipped <= 8  # two of about ten photos, in thirty steps
    state = torch.load(next(trainer.checkpoint_dir.glob("*.ckpt")), weights_only=True)
    assert all_finite(state["pipeline"])
    assert all_finite(state["optimizers"])
    assert all_finite(trainer.pipeline.model.run.statistics)


def test_a_skipped_step_changes_no_parameter_no_moment_and_no_strategy(train, scene, monkeypatch):
    """If every photo breaks, the run ends; its saved parameters are the initial ones."""
    from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer

    spoil(monkeypatch, "image", math.nan, set())
    seen = []
    setup = Lang3DXLTrainer.setup

    def remembering(self, *args, **kwargs):
        setup(self, *args, **kwargs)
        seen.append((self, {n: p.detach().clone() for n, p in self.pipeline.model.named_parameters()}))

    monkeypatch.setattr(Lang3DXLTrainer, "setup", remembering)
    with pytest.raises(UserError, match="6 steps in a row had no finite loss or gradient"):
        train(scene, iterations=30, max_skipped_steps=6, steps_per_eval_image=0)
    trainer, before = seen[0]
    for name, parameter in trainer.pipeline.model.named_parameters():
        assert torch.equal(parameter, before[name]), name
    assert not any(optimizer.state for optimizer in trainer.optimizers.optimizers.values())
    assert trainer.pipeline.model.run.statistics["grad2d"] is None
    assert not list(trainer.checkpoint_dir.glob("*.ckpt"))


def test_a_broken_gradient_of_a_finite_loss_is_kept_out_after_densification_too(train, scene, monkeypatch):
    from lang3dxl_ns.components import losses

    right, calls = losses.rgb_loss, []

    def breaking(prediction, *rest):
        calls.append(prediction.requires_grad)
        if len(calls) % 3 == 0 and prediction.requires_grad:
            prediction.register_hook(lambda gradient: gradient * math.nan)
        return right(prediction, *rest)

    monkeypatch.setattr(losses, "rgb_loss", breaking)
    changes = {"pipeline__model__densify_grad_thresh": 1e-7, "steps_per_eval_image": 0}
    trainer = train(scene, iterations=30, semantics=False, **changes)
    assert trainer.guard.skipped == 10
    assert trainer.pipeline.model.num_points > 700  # the seed points and the sky's
    assert all_finite(dict(trainer.pipeline.model.state_dict()))


@pytest.mark.slow
def test_learning_rates_a_million_apart_end_in_finite_parameters(train, scene):
    trainer = train(scene, iterations=1, steps_per_eval_image=0)
    config = trainer.config
    config.optimizers["scales"]["optimizer"].lr = 50.0
    config.optimizers["quats"]["optimizer"].lr = 1e-6
    config.max_num_iterations = 15
    again = config.setup(local_rank=0, world_size=1)
    again.setup()
    again.train()
    state = dict(again.pipeline.model.state_dict())
    unknown = state["gauss_params.codes"].isnan().all(1)  # Gaussians that no photo shows
    state["gauss_params.codes"] = state["gauss_params.codes"][~unknown]
    assert all_finite(state)
