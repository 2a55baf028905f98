"""Average precision and its means, against values worked out by hand."""

import numpy as np
import pytest

from lang3dxl_ns.evaluation.average_precision import (
    average_precision,
    deviation_over_photos,
    mean_over_photos,
)


def test_values_worked_out_by_hand():
    truth = np.array([[False, True], [False, True]])
    assert average_precision(np.array([[0.1, 0.9], [0.2, 0.8]]), truth) == 1
    assert average_precision(np.array([[0.9, 0.1], [0.8, 0.2]]), truth) == pytest.approx((1 / 3 + 2 / 4) / 2)


def test_pixels_with_one_score_count_as_one_step():
    """Their arbitrary order must not matter."""
    truth = np.array([True, False, False, True])
    assert average_precision(np.zeros(4), truth) == pytest.approx(0.5)
    assert average_precision(np.zeros(4), truth[::-1]) == pytest.approx(0.5)


def test_chance_scores_the_share_of_positives():
    rng = np.random.default_rng(0)
    assert average_precision(rng.random(20_000), rng.random(20_000) < 0.2) == pytest.approx(0.2, abs=0.02)


def test_the_order_of_pixels_and_any_rising_function_of_the_score_change_nothing():
    rng = np.random.default_rng(1)
    score, truth, order = rng.random(500), rng.random(500) < 0.3, rng.permutation(500)
    expected = average_precision(score, truth)
    assert average_precision(score[order], truth[order]) == pytest.approx(expected)
    assert average_precision(np.exp(5 * score), truth) == pytest.approx(expected)


def test_average_precision_is_undefined_without_a_positive():
    assert average_precision(np.zeros((2, 2)), np.zeros((2, 2), bool)) is None


def test_maps_of_two_shapes_are_refused():
    with pytest.raises(ValueError, match="shape"):
        average_precision(np.zeros((2, 2)), np.zeros((4,), bool))


def test_means_are_over_the_photos_that_have_a_value():
    photos = [{"a": 1.0, "b": 2.0}, {"a": 3.0}]
    assert mean_over_photos(photos) == {"a": 2.0, "b": 2.0}
    assert deviation_over_photos(photos) == {"a": pytest.approx(2**0.5), "b": 0.0}
