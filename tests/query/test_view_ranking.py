"""Ranking of views: laws on views whose contents are known."""

import pytest
import torch

from lang3dxl_ns.query.view_ranking import rank_views
from lang3dxl_ns.query.visibility import VisibleGaussians
from lang3dxl_ns.scene.camera import Camera

SIDE = 64


def view(scores: torch.Tensor) -> tuple[torch.Tensor, VisibleGaussians, torch.Tensor]:
    """A Gaussian for every pixel of a picture of relevancies, in front of a camera at the origin."""
    rows, columns = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    k = torch.tensor([[float(SIDE), 0, SIDE / 2], [0, float(SIDE), SIDE / 2], [0, 0, 1]])
    x, y = (columns + 0.5 - SIDE / 2) / SIDE, (rows + 0.5 - SIDE / 2) / SIDE
    means = torch.stack([x, y, torch.ones_like(x)], -1).view(-1, 3)
    seen = VisibleGaussians.of(Camera(torch.eye(4), k, SIDE, SIDE), torch.ones(SIDE * SIDE))
    return means, seen, scores.reshape(-1)


def spot(size: int, value: float = 0.9, at: tuple[int, int] = (SIDE // 2, SIDE // 2)) -> torch.Tensor:
    """A square match in a picture."""
    picture = torch.full((SIDE, SIDE), 0.2)
    row, column = (middle - size // 2 for middle in at)
    picture[max(row, 0) : row + size, max(column, 0) : column + size] = value
    return picture


def ranks(pictures: dict[str, torch.Tensor], threshold: float = 0.5) -> list[str]:
    """Names of views that each show their own Gaussians, best first."""
    parts = {name: view(picture) for name, picture in pictures.items()}
    means = torch.cat([part[0] for part in parts.values()])
    scores = torch.cat([part[2] for part in parts.values()])
    views = {
        name: VisibleGaussians(seen.camera, seen.rows + i * SIDE * SIDE, seen.shares)
        for i, (name, (_, seen, _)) in enumerate(parts.items())
    }
    found = rank_views(views, means, scores, threshold)
    return [view.name for view in sorted(found, key=lambda view: view.rank, reverse=True)]


def test_the_peak_comes_before_the_area():
    """A rose window, and a façade of ordinary windows that are a bit like one."""
    assert ranks({"windows": spot(40, 0.6), "rose": spot(12, 0.9)}) == ["rose", "windows"]


def test_of_equal_peaks_the_larger_wins():
    assert ranks({"small": spot(6), "large": spot(20)}) == ["large", "small"]


@pytest.mark.parametrize("rim", [(4, 32), (32, 60), (2, 2)])
def test_of_equal_sizes_the_centered_wins(rim):
    assert ranks({"rim": spot(8, at=rim), "middle": spot(8)}) == ["middle", "rim"]


def test_a_stray_pixel_is_no_peak():
    picture = spot(16, 0.7)
    stray = torch.full((SIDE, SIDE), 0.2)
    stray[32, 32] = 0.99
    assert ranks({"stray": stray, "match": picture})[0] == "match"


def test_what_is_hidden_does_not_count():
    means, seen, scores = view(spot(16))
    shown = scores < 0.5
    hidden = VisibleGaussians(seen.camera, seen.rows[shown], seen.shares[shown])
    found = {v.name: v for v in rank_views({"seen": seen, "hidden": hidden}, means, scores, 0.5)}
    assert found["hidden"].area == 0 and found["seen"].rank > found["hidden"].rank


def test_without_a_match_the_view_that_comes_closest_is_first():
    assert ranks({"far": spot(16, 0.25), "near": spot(16, 0.4)})[0] == "near"
    means, seen, scores = view(spot(16, 0.4))
    assert rank_views({"near": seen}, means, scores, 0.5)[0].area == 0


def test_a_gaussian_that_fills_a_large_view_has_a_rank():
    """More pixels than half precision can count."""
    camera = Camera(torch.eye(4), torch.tensor([[300.0, 0, 150], [0, 300, 150], [0, 0, 1]]), 300, 300)
    wall = VisibleGaussians.of(camera, torch.tensor([90_000.0, 3e-3]))
    torch.testing.assert_close(wall.pixels, torch.tensor([90_000.0, 3e-3]))
    (found,) = rank_views({"wall": wall}, torch.tensor([[0.0, 0, 1]] * 2), torch.tensor([0.9, 0.1]), 0.5)
    assert 0 < found.rank <= 1 and found.area == pytest.approx(1)
