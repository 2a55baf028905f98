"""Boxes around matches in 3D."""

import pytest
import torch
from sklearn.cluster import DBSCAN

from lang3dxl_ns.query.view_ranking import strongest_match


def clouds(*places: float, count: int = 500) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.cat([p + torch.rand(count, 3, generator=generator) for p in places])


def box_of(points, scores, mass=None, gap=0.3):
    mass = torch.ones(len(points)) if mass is None else mass
    return strongest_match(points, scores, mass, 0.5, gap)


def test_the_heavier_of_two_matches_wins_though_it_has_fewer_points():
    points = torch.cat([clouds(0.0, count=2000), clouds(5.0, count=1000)])
    mass = torch.cat([torch.full((2000,), 0.1), torch.full((1000,), 0.3)])
    box = box_of(points, torch.full((3000,), 0.8), mass)
    assert all(5.0 <= low < 5.1 for low in box.low) and all(5.9 < high <= 6.0 for high in box.high)
    assert box.share == pytest.approx(0.6, rel=1e-4)
    assert box.center == pytest.approx((5.5, 5.5, 5.5), abs=0.05)


def test_weaker_matches_around_the_best_do_not_widen_its_box():
    """Four windows that are a bit like a rose, around the rose window that is."""
    points = torch.cat([clouds(1.0), clouds(0.0, 0.5, 1.5, 2.0)])
    scores = torch.cat([torch.full((500,), 0.9), torch.full((2000,), 0.75)])
    box = box_of(points, scores)
    assert min(box.low) >= 1.0 and max(box.high) <= 2.0


def test_nothing_depends_on_where_the_world_begins():
    points = clouds(0.0, 3.0)
    scores = torch.linspace(0.8, 0.9, 1000)
    here, there = (box_of(points + shift, scores, gap=0.4) for shift in (0.0, -40.0))
    torch.testing.assert_close(torch.tensor(here.low) - 40, torch.tensor(there.low), atol=1e-4, rtol=0)


def test_a_few_stray_points_do_not_widen_the_box():
    points = torch.cat([clouds(0.0), torch.tensor([[1.0 + 0.2 * i, 0.5, 0.5] for i in range(6)])])
    assert box_of(points, torch.full((506,), 0.9)).high[0] < 1.05


def test_one_point_is_a_box_and_none_is_not():
    box = box_of(torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([0.9]), gap=0.1)
    assert box.low == box.high == (1.0, 2.0, 3.0) and box.share == 1.0
    assert box_of(clouds(0.0), torch.full((500,), 0.5)) is None


def test_a_tall_thing_that_matches_less_towards_its_foot_is_boxed_whole_and_what_it_stands_on_is_not():
    """A minaret is sure at its top and likely further down; the mosque below it merely resembles one."""
    minaret = clouds(0.0, count=1_000) * torch.tensor([0.2, 0.2, 1.5])
    mosque = clouds(0.0, count=4_000) * torch.tensor([2.0, 2.0, 1.0]) - torch.tensor([0.0, 0.0, 1.0])
    scores = torch.cat([0.85 + 0.1 * minaret[:, 2] / 1.5, torch.full((4_000,), 0.6)])
    box = box_of(torch.cat([minaret, mosque]), scores)
    assert box.low[2] == pytest.approx(0.0, abs=0.1) and box.high[2] == pytest.approx(1.5, abs=0.1)
    scores[1_000:] = 0.74  # good matches now, joined with the minaret
    assert box_of(torch.cat([minaret, mosque]), scores).low[2] > 0.5


def test_a_heap_of_points_in_one_place_is_grouped_as_those_around_it(monkeypatch):
    """Each of 20,000 would have all others as neighbors."""
    neighborhoods = []
    fit_predict = DBSCAN.fit_predict

    def counting(self, points, **given):
        neighborhoods.append(int((torch.cdist(*[torch.from_numpy(points)] * 2) < self.eps).sum()))
        return fit_predict(self, points, **given)

    monkeypatch.setattr(DBSCAN, "fit_predict", counting)
    heap = 0.1 * clouds(0.0, count=20_000)
    both = torch.cat([heap, clouds(3.0, count=100)])
    box = box_of(both, torch.full((len(both),), 0.8))
    assert box.share == pytest.approx(20_000 / 20_100, rel=1e-3)
    assert max(box.high) < 0.11 and max(neighborhoods) < 1e6
