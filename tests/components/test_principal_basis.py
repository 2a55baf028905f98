"""Laws of the principal components of features."""

import pytest
import torch

from lang3dxl_ns.components.principal_basis import PrincipalBasis


def features(rows=400, channels=20, rank=5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(rank, channels, generator=generator)
    return 3 + torch.randn(rows, rank, generator=generator) @ directions


def test_the_parts_and_their_order_do_not_matter():
    known = features(rank=20)
    whole = PrincipalBasis.of([known], 3)
    parts = PrincipalBasis.of(reversed(known.split(7)), 3)
    torch.testing.assert_close(parts.mean, whole.mean)
    turn = parts.axes.T @ whole.axes  # axes may point the other way
    torch.testing.assert_close(turn.abs(), torch.eye(3), atol=1e-4, rtol=0)


def test_rows_with_nan_are_left_out():
    known = features()
    spoiled = torch.cat([known, torch.full((30, 20), torch.nan)])
    spoiled[-1, 0] = torch.inf
    expected, basis = PrincipalBasis.of([known], 2), PrincipalBasis.of([spoiled], 2)
    torch.testing.assert_close(basis.mean, expected.mean)
    torch.testing.assert_close(basis.axes, expected.axes)
    with pytest.raises(ValueError, match="no feature is finite"):
        PrincipalBasis.of([spoiled[-30:]], 2)
