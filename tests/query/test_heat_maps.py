"""Heat maps of relevancy."""

import numpy as np
import pytest
import torch

from lang3dxl_ns.query.heat_maps import color, heat, overlay, strongest, tinted, with_legend

RELEVANCY = torch.tensor([[0.0, 0.4, 0.5], [0.55, 0.6, 0.7]])
IMAGE = torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(0))


def test_heat_starts_at_the_threshold_and_ends_at_the_highest():
    torch.testing.assert_close(heat(RELEVANCY), torch.tensor([[0.0, 0.0, 0.0], [0.25, 0.5, 1.0]]))


def test_a_map_below_the_threshold_is_cold():
    assert (heat(torch.full((2, 2), 0.3)) == 0).all()


def test_only_what_matches_is_painted():
    mask = torch.tensor([[False] * 3, [True] * 3])
    picture = overlay(IMAGE, RELEVANCY, mask, 0.5)
    assert torch.equal(picture[0], IMAGE[0])
    assert (picture[1] != IMAGE[1]).any(1).all()
    assert picture.min() >= 0 and picture.max() <= 1
    assert torch.equal(overlay(IMAGE, RELEVANCY, torch.zeros_like(mask), 0.5), IMAGE)


def test_a_peak_outside_of_what_matches_does_not_cool_it():
    peak = torch.where(torch.tensor([[True, False, False], [False] * 3]), 1.0, RELEVANCY)
    mask = RELEVANCY > 0.5
    assert torch.equal(overlay(IMAGE, peak, mask, 0.5), overlay(IMAGE, RELEVANCY, mask, 0.5))


def test_the_most_relevant_prompt_that_matches_a_place_colors_it():
    maps = torch.tensor([[[0.9, 0.6, 0.3]], [[0.5, 0.7, 0.8]]])
    masks = torch.tensor([[[False, True, False]], [[True, True, False]]])
    best, which = strongest(maps, masks)
    assert best.tolist() == [[0.5, pytest.approx(0.7), 0.0]] and which.tolist()[0][:2] == [1, 1]
    picture = tinted(IMAGE[:1], maps, masks, 0.4)
    assert torch.equal(picture[0, 2], IMAGE[0, 2]) and (picture[0, :2] != IMAGE[0, :2]).any(1).all()


def test_colors_are_matplotlibs():
    values = torch.cat([torch.linspace(0, 1, 256), torch.tensor([2.0])])
    colormaps = pytest.importorskip("matplotlib").colormaps
    expected = torch.from_numpy(colormaps["turbo"](values.clamp(0, 1).numpy())[:, :3]).float()
    torch.testing.assert_close(color(values), expected, atol=0.6 / 255, rtol=0)  # stored in bytes


@pytest.mark.parametrize("label", ["wall", "red windows of the left tower " * 5, "w" * 200])
def test_a_legend_holds_labels_of_any_length(label):
    picture = np.zeros((20, 200, 3), np.uint8)
    drawn = with_legend(picture, [label, "wall"])
    assert np.array_equal(drawn[:20], picture) and (drawn[20:, -1] == 255).all()  # not cut
    last = with_legend(picture, ["dome", "wall"])[-16:, 16:]
    np.testing.assert_array_equal(drawn[-16:, 16:], last)  # below, whatever comes first
