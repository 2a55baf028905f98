"""Where Gaussians may be."""

import torch

from lang3dxl_ns.training.gaussians import near_cameras


def test_what_is_near_a_camera_does_not_depend_on_where_the_world_begins():
    generator = torch.Generator().manual_seed(0)
    means, cameras = (2 * torch.rand(n, 3, generator=generator) - 1 for n in (5_000, 200))
    near = torch.cdist(means.double(), cameras.double()).amin(1) < 0.05
    assert 10 < near.sum() < 1_000
    for offset in (0.0, 100.0, 1_000.0):
        found = near_cameras(means + offset, cameras + offset, 0.05)
        assert (found != near).sum() <= 2  # the shift itself rounds
