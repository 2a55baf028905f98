"""Conversions between nerfstudio's cameras and ours keep both axes apart."""

import pytest
import torch
from scenes import view_of

from lang3dxl_ns.plugin.cameras import photo_camera, to_nerfstudio
from lang3dxl_ns.scene.camera import Camera, Lens, view_matrix

LENS = Lens(width=64, height=48, fx=50.0, fy=57.0, cx=30.0, cy=26.0)


@pytest.fixture
def pose():
    generator = torch.Generator().manual_seed(0)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator))[0]
    rotation = rotation * torch.linalg.det(rotation)
    return torch.cat([rotation, torch.tensor([[1.0], [2.0], [3.0]])], dim=1)


def test_nerfstudios_rays_and_the_rasterizers_pixels_agree(pose):
    """A point on nerfstudio's own ray through a pixel projects to that pixel."""
    cameras = to_nerfstudio([LENS], pose[None])
    row, column = 7, 41
    rays = cameras.generate_rays(0, coords=torch.tensor([row + 0.5, column + 0.5]))
    point = rays.origins + 3.0 * rays.directions
    camera = photo_camera(cameras[0:1]).camera(pose)
    x, y, z = camera.view_matrix[:3, :3] @ point + camera.view_matrix[:3, 3]
    assert z > 0
    seen = camera.intrinsics @ (torch.stack([x, y, z]) / z)
    torch.testing.assert_close(seen[:2], torch.tensor([column + 0.5, row + 0.5]), atol=1e-4, rtol=0)


def test_a_camera_of_ours_is_the_same_one_in_nerfstudio(pose):
    camera = LENS.camera(view_matrix(pose))
    back: Camera = photo_camera(view_of(camera)).camera()
    torch.testing.assert_close(back.view_matrix, camera.view_matrix)
    torch.testing.assert_close(back.intrinsics, camera.intrinsics)
    assert (back.width, back.height) == (64, 48)
