"""Laws of the principal components of features."""

import pytest
import torch

from lang3dxl_ns.components.principal_basis import PrincipalBasis


def features(rows=400, channels=20, rank=5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(rank, channels, generator=generator)
    return 3 + torch.randn(rows, rank, generator=generator) @ directions


def test_features_of_low_rank_come_back():
    known = features()
    basis = PrincipalBasis.of([known[:150].reshape(10, 15, -1), known[150:][None]], 5)
    torch.testing.assert_close(basis.features(basis.coordinates(known)), known, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(basis.axes.T @ basis.axes, torch.eye(5), atol=1e-5, rtol=0)


def test_the_parts_and_their_order_do_not_matter():
    known = features(rank=20)
    whole = PrincipalBasis.of([known], 3)
    parts = PrincipalBasis.of(reversed(known.split(7)), 3)
    torch.testing.assert_close(parts.mean, whole.mean)
    turn = parts.axes.T @ whole.axes  # axes may point the other way
    torch.testing.assert_close(turn.abs(), torch.eye(3), atol=1e-4, rtol=0)


def test_it_agrees_with_the_singular_value_decomposition():
    known = features(rank=20).double()
    basis = PrincipalBasis.of([known.float()], 4)
    _, _, directions = torch.linalg.svd(known - known.mean(0), full_matrices=False)
    agreement = (directions[:4].float() @ basis.axes).abs()
    torch.testing.assert_close(agreement, torch.eye(4), atol=1e-3, rtol=0)


def test_a_large_mean_costs_no_precision():
    known = features(rank=3)
    far = PrincipalBasis.of([known + 1e4], 3)
    near = PrincipalBasis.of([known], 3)
    torch.testing.assert_close((far.axes.T @ near.axes).abs(), torch.eye(3), atol=1e-2, rtol=0)


def test_rows_with_nan_are_left_out():
    known = features()
    spoiled = torch.cat([known, torch.full((30, 20), torch.nan)])
    spoiled[-1, 0] = torch.inf
    expected, basis = PrincipalBasis.of([known], 2), PrincipalBasis.of([spoiled], 2)
    torch.testing.assert_close(basis.mean, expected.mean)
    torch.testing.assert_close(basis.axes, expected.axes)
    with pytest.raises(ValueError, match="no feature is finite"):
        PrincipalBasis.of([spoiled[-30:]], 2)
