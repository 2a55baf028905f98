"""Laws of the schedules."""

import math

import numpy as np
import pytest

from lang3dxl_ns.training.learning_rates import cosine_decay, log_linear, semantic_ramp

X = [i / 100 for i in range(101)]


def test_a_log_linear_schedule_multiplies_by_one_factor_per_step():
    values = [log_linear(x, 1.6e-5, 1.6e-7) for x in X]
    np.testing.assert_allclose(np.array(values[1:]) / values[:-1], 0.01**0.01)
    assert values[0] == pytest.approx(1.6e-5)
    assert values[-1] == pytest.approx(1.6e-7)


@pytest.mark.parametrize("share", [0.5, 15_000 / 70_000])
def test_the_semantic_ramp_rises_from_a_tenth_to_one_in_its_share_of_the_run(share):
    assert semantic_ramp(0, share) == pytest.approx(0.1)
    assert semantic_ramp(share / 2, share) == pytest.approx(math.sqrt(0.1))
    assert [semantic_ramp(x, share) for x in (share, 0.75, 1)] == pytest.approx([1, 1, 1])
    assert semantic_ramp(0, 0) == pytest.approx(1)


@pytest.mark.parametrize("power", [1, 2])
def test_a_cosine_falls_from_peak_to_end_without_turning(power):
    values = [cosine_decay(x, 5e-4, 5e-6, power) for x in X]
    assert values[0] == pytest.approx(5e-4)
    assert values[-1] == pytest.approx(5e-6)
    assert values == sorted(values, reverse=True)
    assert cosine_decay(0.5 ** (1 / power), 5e-4, 5e-6, power) == pytest.approx((5e-4 + 5e-6) / 2)


def test_beyond_its_range_a_schedule_keeps_the_nearer_end():
    for schedule in (
        lambda x: log_linear(x, 1, 2),
        lambda x: cosine_decay(x, 2, 1, 2),
        lambda x: semantic_ramp(x, 0.3),
    ):
        assert schedule(-1) == schedule(0)
        assert schedule(2) == schedule(1)
