import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics

from lang3dxl_ns.rendering import spherical_harmonics


def sample(count: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return directions, torch.randn(count, 16, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors_equal_those_of_gsplat(degree):
    directions, coefficients = sample()
    expected = _spherical_harmonics(degree, directions, coefficients)
    torch.testing.assert_close(
        spherical_harmonics(degree, directions, coefficients), expected, atol=1e-9, rtol=0
    )


def test_the_length_of_a_direction_does_not_matter():
    directions, coefficients = sample()
    torch.testing.assert_close(
        spherical_harmonics(3, 7.5 * directions, coefficients),
        spherical_harmonics(3, directions, coefficients),
    )


def test_bands_above_the_degree_are_ignored():
    directions, coefficients = sample()
    torch.testing.assert_close(
        spherical_harmonics(1, directions, coefficients),
        spherical_harmonics(1, directions, coefficients[:, :4]),
    )


def test_gradients_equal_finite_differences():
    directions, coefficients = (tensor[:3].requires_grad_() for tensor in sample())
    assert torch.autograd.gradcheck(lambda d, c: spherical_harmonics(3, d, c), (directions, coefficients))


def test_missing_coefficients_are_reported_with_both_numbers():
    directions, coefficients = sample()
    with pytest.raises(ValueError, match=r"degree 2 .* 9 coefficients .* there are 4"):
        spherical_harmonics(2, directions, coefficients[:, :4])
