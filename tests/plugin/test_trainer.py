"""Run-relative schedules and rates, as plain floats in the checkpoint."""

import pytest
import torch

from lang3dxl_ns.plugin.optimizers import LONG_RUN, SHORT_RUN, RunAdamConfig, RunScheduleConfig


@pytest.mark.parametrize("steps", [10, 1000, 30_000])
def test_a_schedule_has_the_same_shape_at_every_length(steps):
    schedule = RunScheduleConfig(start=0.1, warm=0.2, end=0.01, power=2.0, total_steps=steps).setup()
    assert schedule.multiple(0) == pytest.approx(0.1)
    assert schedule.multiple(round(0.2 * steps)) == pytest.approx(1.0)
    assert schedule.multiple(steps) == pytest.approx(0.01)
    assert schedule.multiple(2 * steps) == pytest.approx(0.01)


def test_log_linear_decay_halves_the_exponent_halfway():
    schedule = RunScheduleConfig(shape="log-linear", end=0.01, total_steps=100).setup()
    assert schedule.multiple(50) == pytest.approx(0.1)


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
    config.fit(iterations)
    assert config.lr == pytest.approx(rate)
    config.fit(LONG_RUN)  # resolved once: a config read from disk stays as trained
    assert config.lr == pytest.approx(rate)
