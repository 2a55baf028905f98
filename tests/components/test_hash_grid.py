"""Laws of the hash grid, against the float64 reference of the numerics."""

import itertools

import pytest
import torch

from lab.numerics.hash_grid import interpolate_reference
from lang3dxl_ns.components.hash_grid import HASH_PRIMES, HashGrid

pytestmark = pytest.mark.usefixtures("backend")
PRIMES = (1, 2654435761, 805459861, 3674653429)


def make_grid(input_dim=3, levels=4, features=2, log2_table_size=7, lowest=4, highest=24, seed=0):
    """A float64 grid with entries of order one; in any dimension level 0 is dense, the last hashed."""
    generator = torch.Generator().manual_seed(seed)
    if input_dim == 4:
        log2_table_size = 9
    grid = HashGrid(
        input_dim, levels, features, log2_table_size, lowest, highest, generator=generator
    ).double()
    with torch.no_grad():
        grid.table.copy_(torch.randn(grid.table.shape, generator=generator, dtype=torch.float64))
    return grid


def make_points(count, dim, low=0.0, high=1.0, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(count, dim, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("dim", [2, 3, 4])
@pytest.mark.parametrize("spread", [(0.0, 1.0), (-3.0, 3.0)])
def test_values_and_gradients_equal_the_reference(dim, spread):
    grid = make_grid(dim)
    assert 0 < grid.dense_levels < grid.levels
    assert (grid.cells + 2).tolist() == [4, 8, 14, 24] and tuple(HASH_PRIMES[:4]) == PRIMES
    x = make_points(12, dim, *spread).requires_grad_()
    weight = make_points(12, grid.output_dim, seed=2)
    found, expected = grid(x), interpolate_reference(grid, grid.table, x)
    torch.testing.assert_close(found, expected)
    gradients, right = (
        torch.autograd.grad((out * weight).sum(), (x, grid.table)) for out in (found, expected)
    )
    torch.testing.assert_close(gradients, right)


@pytest.mark.parametrize("value", [0.0, 1.0, 0.5, 0.25])
def test_coordinates_have_a_gradient_at_the_ends_of_the_range_and_on_vertices(value):
    grid = make_grid(levels=1, lowest=4, highest=4)  # two cells to the unit: 0.25 and 0.75 lie on vertices
    x = torch.full((1, 3), value, dtype=torch.float64, requires_grad=True)
    grid(x).sum().backward()
    assert (x.grad.abs() > 1e-3).all()


@pytest.mark.parametrize("dim", [2, 3, 4])
def test_dense_levels_keep_every_vertex_apart(dim):
    """Each vertex touched by [0, 1], both ends included, has its own entry; none is unused."""
    resolution = 5
    grid = HashGrid(dim, 1, 1, 10, resolution, resolution)
    corners = torch.tensor(list(itertools.product(range(resolution), repeat=dim)))
    entries = grid._vertex_entries(corners.T[:, None])[0, 0]
    assert sorted(entries.tolist()) == list(range(resolution**dim))
    ends = (torch.tensor([0.0, 1.0]) * grid.cells + 0.5).floor()
    assert ends[0] >= 0
    assert ends[1] + 1 <= resolution - 1


def test_features_are_continuous_across_cell_borders():
    grid = make_grid()
    borders = torch.cat([(torch.arange(12) - 4 + 0.5) / float(cells) for cells in grid.cells]).double()
    here = make_points(len(borders), 3)
    here[:, 1] = borders
    step = torch.tensor([0.0, 1e-9, 0.0], dtype=torch.float64)
    torch.testing.assert_close(grid(here - step), grid(here + step), atol=1e-6, rtol=0)


def test_no_points_give_no_features_and_no_gradient():
    grid = make_grid()
    x = torch.zeros(0, 3, dtype=torch.float64, requires_grad=True)
    features = grid(x)
    features.sum().backward()
    assert features.shape == (0, grid.output_dim)
    assert not grid.table.grad.any()


def test_initial_entries_are_small_and_follow_the_generator():
    first, again = (
        HashGrid(3, 2, 4, 12, 8, 16, generator=torch.Generator().manual_seed(3)) for _ in range(2)
    )
    other = HashGrid(3, 2, 4, 12, 8, 16, generator=torch.Generator().manual_seed(4))
    assert torch.equal(first.table, again.table)
    assert not torch.equal(first.table, other.table)
    assert 0.9e-4 < first.table.abs().max() <= 1e-4


@pytest.mark.parametrize("dim", [1, 7])
def test_other_dimensions_are_refused(dim):
    with pytest.raises(ValueError, match="input_dim"):
        HashGrid(dim, 4, 2, 8, 4, 24)


def test_a_grid_of_no_levels_has_no_features():
    grid = HashGrid(3, 0, 4, 8, 4, 24)
    assert grid(torch.rand(5, 3)).shape == (5, 0)
    assert grid.output_dim == 0


def test_six_dimensions_interpolate_between_distinct_vertices():
    grid = make_grid(6, levels=1, lowest=6, highest=6, log2_table_size=16)
    x = torch.full((2, 6), 0.3, dtype=torch.float64)
    x[1, 5] = 0.8
    assert not torch.equal(*grid(x))
    torch.testing.assert_close(grid(x[:1] + 1e-9), grid(x[:1]), rtol=0, atol=1e-6)
