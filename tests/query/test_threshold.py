"""Laws of the relevancy from which places match."""

import pytest
import torch

from lang3dxl_ns.query.thresholds import EVEN, SHARE, match_thresholds


def scene(level: float, peak: float, count: int = 1_000, share: float = 0.02) -> torch.Tensor:
    """Relevancy of Gaussians: a thing at the peak, all else at a level."""
    values = torch.full((1, count), level)
    values[0, : int(share * count)] = peak
    return values


def test_what_stands_out_matches_although_negatives_fit_better():
    (threshold,) = match_thresholds(scene(0.02, 0.45), [0.0], [False])
    assert 0.02 < threshold < 0.45


@pytest.mark.parametrize(("level", "peak"), [(0.0, 0.9), (0.2, 0.6), (0.4, 0.95), (0.6, 0.99), (0.0, 1.0)])
def test_it_lies_between_the_rest_and_the_peak_and_asks_for_no_more_than_even(level, peak):
    (threshold,) = match_thresholds(scene(level, peak), [0.0], [False])
    assert threshold == pytest.approx(min(level + SHARE * (peak - level), EVEN))


def test_what_every_place_fits_as_well_is_no_match():
    """As of a CLIP whose relevancies hardly differ: all near 0.45, and nothing stands out."""
    relevancy = 0.45 + 0.01 * torch.rand(1, 2_000, generator=torch.Generator().manual_seed(0))
    (threshold,) = match_thresholds(relevancy, [0.0], [False])
    assert (relevancy > threshold).double().mean() < 0.5


def test_doubtful_prompts_have_to_beat_their_negatives():
    relevancy = torch.cat([scene(0.0, 0.4), scene(0.0, 0.4)])
    sure, doubtful = match_thresholds(relevancy, [0.02, 0.5], [False] * 2)
    assert doubtful == EVEN and sure < 0.4


def test_negatives_of_ones_own_have_to_be_beaten():
    relevancy = torch.cat([scene(0.0, 0.49), scene(0.0, 0.49)])
    plain, named = match_thresholds(relevancy, [0.0, 0.0], [False, True])
    assert plain < 0.49 < named == EVEN


def test_a_large_thing_is_told_apart_from_the_median_not_from_what_it_is_least_like():
    """In a scene whose larger half has 0.3, matches begin above that."""
    relevancy = torch.cat([torch.zeros(400), torch.full((550,), 0.3), torch.full((50,), 0.5)])[None]
    (threshold,) = match_thresholds(relevancy, [0.0], [False])
    assert threshold == pytest.approx(0.3 + SHARE * 0.2)


def test_the_order_of_gaussians_does_not_matter():
    relevancy = torch.rand(3, 999, generator=torch.Generator().manual_seed(0))
    shuffled = relevancy[:, torch.randperm(999)]
    assert match_thresholds(shuffled, [0.0] * 3, [False] * 3) == pytest.approx(
        match_thresholds(relevancy, [0.0] * 3, [False] * 3)
    )


def test_without_gaussians_nothing_is_asked():
    assert match_thresholds(torch.zeros(2, 0), [0.0, 0.0], [False] * 2) == (EVEN, EVEN)
