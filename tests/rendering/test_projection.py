import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from splat_clouds import gaussians, make_cloud

from lang3dxl_ns.rendering import Gaussians, fused_projection, projection
from lang3dxl_ns.scene.camera import Camera

SETTINGS = {"near": 0.01, "eps2d": 0.3, "antialiased": False}


@pytest.fixture(params=[projection, fused_projection], ids=["torch", "numba"])
def project(request):
    return request.param.project


def project_with_gsplat(cloud, tensors):
    covariances, _ = _quat_scale_to_covar_preci(tensors["quats"], tensors["scales"], compute_preci=False)
    return _fully_fused_projection(
        tensors["means"], covariances, tensors["view_matrix"][None], cloud.intrinsics[None],
        cloud.width, cloud.height, calc_compensations=True,
    )  # fmt: skip


def test_everything_in_sight_is_projected_as_by_gsplat(project):
    cloud = make_cloud(500, 64, 48)
    tensors = cloud.tensors
    radii, means2d, depths, conics, compensations = project_with_gsplat(cloud, tensors)
    seen = radii[0] > 0
    splats = project(gaussians(tensors), cloud.camera(tensors), **SETTINGS | {"antialiased": True})
    assert 0.3 < seen.double().mean() < 0.9
    torch.testing.assert_close(splats.radii, radii)
    torch.testing.assert_close(splats.means2d[0, seen], means2d[0, seen])
    torch.testing.assert_close(splats.depths[seen], depths[0, seen])
    torch.testing.assert_close(splats.conics[seen], conics[0, seen])
    torch.testing.assert_close(splats.opacities[seen], (tensors["opacities"] * compensations[0])[seen])


def test_gradients_equal_those_of_gsplat(project):
    cloud = make_cloud(300, 64, 48)
    found, expected = cloud.leaves(), cloud.leaves()
    radii, means2d, depths, conics, _ = project_with_gsplat(cloud, expected)
    seen = radii[0] > 0
    splats = project(gaussians(found), cloud.camera(found), **SETTINGS)
    names = ("means", "quats", "scales", "view_matrix")
    for ours, theirs in (
        (splats.means2d, means2d),
        (splats.depths[None], depths),
        (splats.conics[None], conics),
    ):
        upstream = torch.randn(ours[:, seen].shape, dtype=torch.float64)
        ours_gradients = torch.autograd.grad(
            ours[:, seen], [found[n] for n in names], upstream, retain_graph=True, allow_unused=True
        )
        their_gradients = torch.autograd.grad(
            theirs[:, seen], [expected[n] for n in names], upstream, retain_graph=True, allow_unused=True
        )
        for a, b in zip(ours_gradients, their_gradients, strict=True):
            if a is None or b is None:
                assert not any(gradient is not None and gradient.any() for gradient in (a, b))
            else:
                torch.testing.assert_close(a, b)


def test_variances_are_the_diagonal_of_the_inverse_conics(project):
    cloud = make_cloud(200, 64, 48)
    splats = project(gaussians(cloud.tensors), cloud.camera(cloud.tensors), **SETTINGS)
    a, b, c = splats.conics.unbind(1)
    inverse = torch.linalg.inv(torch.stack([a, b, b, c], dim=1).view(-1, 2, 2))
    torch.testing.assert_close(splats.variances, inverse.diagonal(dim1=1, dim2=2))


@pytest.mark.parametrize("antialiased", [False, True])
def test_needles_keep_their_conic_in_float32(project, antialiased):
    cloud = make_cloud(300, 64, 48, size=1e-4)
    cloud.tensors["scales"][:, 2] = 1.0
    double = project(
        gaussians(cloud.tensors), cloud.camera(cloud.tensors), **SETTINGS | {"antialiased": antialiased}
    )
    single = {name: value.float() for name, value in cloud.tensors.items()}
    splats = project(gaussians(single), cloud.camera(single), **SETTINGS | {"antialiased": antialiased})
    size = double.conics.norm(dim=1)
    assert float(((splats.conics - double.conics).norm(dim=1) / size).max()) < 1e-4


def test_what_is_behind_the_near_plane_has_no_radius_and_no_opacity(project):
    camera = Camera(torch.eye(4), torch.tensor([[50.0, 0, 16], [0, 50, 16], [0, 0, 1]]), 32, 32)
    means = torch.tensor([[0, 0, 1.0], [0, 0, 0.009], [0, 0, -1.0]])
    splats = project(
        Gaussians(means, torch.ones(3, 4), torch.full((3, 3), 0.01), torch.ones(3)), camera, **SETTINGS
    )
    assert (splats.radii[0] > 0).tolist() == [True, False, False]
    assert splats.opacities.tolist() == [1.0, 0.0, 0.0]
