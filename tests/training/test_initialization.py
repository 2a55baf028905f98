"""Where Gaussians begin, and where they may be."""

import torch

from lang3dxl_ns.training import gaussians
from lang3dxl_ns.training.gaussians import near_cameras, seed_positions


def test_of_a_dense_cloud_some_points_with_their_own_colors_are_where_gaussians_begin(monkeypatch, capsys):
    monkeypatch.setattr(gaussians, "MOST", 20)
    points = torch.rand(200, 3, dtype=torch.float64), torch.arange(600).reshape(200, 3) % 256
    few = seed_positions((points[0][:20], points[1][:20]), 0, 1.0)
    assert torch.equal(few[0], points[0][:20].float()) and not capsys.readouterr().out
    (means, colors), again = seed_positions(points, 0, 1.0), seed_positions(points, 0, 1.0)
    assert torch.equal(means, again[0]) and torch.equal(colors, again[1])
    assert "Gaussians start from 20 of the 200 points" in capsys.readouterr().out
    same = (means[:, None] == points[0].float()).all(2)
    assert same.sum(1).eq(1).all() and same.sum(0).max() == 1  # each is one, and none is drawn twice
    rows = same.int().argmax(1)
    assert rows.max() > 100 and torch.equal(colors, points[1][rows].float() / 255)


def test_what_is_near_a_camera_does_not_depend_on_where_the_world_begins():
    generator = torch.Generator().manual_seed(0)
    means, cameras = (2 * torch.rand(n, 3, generator=generator) - 1 for n in (5_000, 200))
    near = torch.cdist(means.double(), cameras.double()).amin(1) < 0.05
    assert 10 < near.sum() < 1_000
    for offset in (0.0, 100.0, 1_000.0):
        found = near_cameras(means + offset, cameras + offset, 0.05)
        assert (found != near).sum() <= 2  # the shift itself rounds
