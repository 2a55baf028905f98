"""Run-relative schedules and rates, as plain floats in the checkpoint."""

from copy import deepcopy
from dataclasses import is_dataclass

import pytest
import torch

from lang3dxl_ns.methods import lang3dxl
from lang3dxl_ns.plugin.optimizers import RunAdamConfig, RunScheduleConfig
from lang3dxl_ns.training.learning_rates import LONG_RUN, SHORT_RUN


@pytest.mark.parametrize("steps", [10, 1000, 30_000])
def test_a_schedule_has_the_same_shape_at_every_length(steps):
    schedule = RunScheduleConfig(start=0.1, warm=0.2, end=0.01, power=2.0, total_steps=steps)
    assert schedule.multiple(0) == pytest.approx(0.1)
    assert schedule.multiple(round(0.2 * steps)) == pytest.approx(1.0)
    assert schedule.multiple(steps) == pytest.approx(0.01)
    assert schedule.multiple(2 * steps) == pytest.approx(0.01)


def test_schedules_leave_plain_floats_in_the_checkpoint():
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    scheduler = RunScheduleConfig(end=0.1, total_steps=10).setup().get_scheduler(optimizer, 1.0)
    optimizer.step()
    scheduler.step()
    assert type(optimizer.param_groups[0]["lr"]) is float


@pytest.mark.parametrize(
    ("iterations", "rate"), [(10, 1e-2), (SHORT_RUN, 1e-2), (LONG_RUN, 1e-4), (10 * LONG_RUN, 1e-4)]
)
def test_rates_go_from_those_of_short_runs_to_those_of_long_ones(iterations, rate):
    config = RunAdamConfig(lr=1e-4, short_lr=1e-2)
    config = config.fitted(iterations)
    assert config.lr == pytest.approx(rate)
    config = config.fitted(LONG_RUN)  # resolved once: a config read from disk stays as trained
    assert config.lr == pytest.approx(rate)


def settled(iterations: int, **changes) -> dict[str, object]:
    """Every setting of a run of this length, by its dotted name."""
    config = deepcopy(lang3dxl.config)
    config.max_num_iterations = iterations
    for name, value in changes.items():
        setattr(config.pipeline.model.decoder, name, value)
    config.fit_to_run()
    found: dict[str, object] = {}

    def collect(owner, place: str) -> None:
        if is_dataclass(owner) or isinstance(owner, dict):
            for name, value in (owner if isinstance(owner, dict) else vars(owner)).items():
                collect(value, f"{place}.{name}")
        else:
            found[place] = owner

    collect(config, "")
    return found


@pytest.mark.parametrize("decoder", ["gathered", "paper"])
def test_an_iteration_more_changes_no_setting_by_much(decoder):
    """Whatever the length: runs of 4,999 and of 5,000 iterations are alike. Only a decoder that is
    trained with the scene comes in two sizes, and the paper's with its downsampler."""
    two_sizes = (".pipeline.model.semantic_field.preset", ".pipeline.model.downsampler.")
    lengths = [*(round(100 * 1.3**i) for i in range(24)), 4_999]
    for length in lengths:
        before, after = (settled(n, name=decoder) for n in (length, length + 1))
        assert before.keys() == after.keys()
        changed = [name for name in before if before[name] != after[name]]
        for name in changed:
            if name.startswith(two_sizes) and decoder == "paper" and length == 4_999:
                continue
            old, new = (torch.tensor(values[name], dtype=torch.float64) for values in (before, after))
            # By an iteration in proportion, or by one in what is counted.
            assert (
                (new - old).abs() <= torch.maximum(old / length * 1.5, torch.ones(()) * (old >= 2))
            ).all(), name


def test_between_short_and_long_runs_every_rate_goes_one_way():
    lengths = [10, 300, 1_000, 1_200, 3_000, 4_999, 5_000, 10_000, 30_000, 100_000]
    runs = [settled(length) for length in lengths]
    rates = [name for name in runs[0] if name.endswith(("optimizer.lr", "densify_grad_thresh"))]
    assert len(rates) > 10
    for name in rates:
        values = torch.tensor([run[name] for run in runs], dtype=torch.float64)
        assert (values.diff() <= 0).all(), name
        assert values[0] == values[2] and values[-1] == values[-2], name
