"""Laws of the search for codes that a field decodes to given features."""

import pytest
import torch
import torch.nn.functional as F

from lang3dxl_ns.components.code_search import nearest, settle
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.components.semantic_field import SemanticField

CHANNELS = 12


def bumpy(dim: int) -> SemanticField:
    """A field whose output varies with its code as strongly as a trained one's."""
    draw = torch.Generator().manual_seed(0)
    field = SemanticField(SemanticFieldConfig("short", code_dim=dim), CHANNELS, generator=draw)
    field.grid.table.data.normal_(std=0.1, generator=draw)
    return field


def error(field, codes, features):
    with torch.no_grad():
        return (field.decode_clip(codes) - features).square().sum(1)


@pytest.mark.parametrize("dim", [2, 3, 6])
def test_settling_leads_nearer_and_never_farther(dim):
    field, draw = bumpy(dim), torch.Generator().manual_seed(1)
    codes, features = torch.randn(200, dim, generator=draw), torch.randn(200, CHANNELS, generator=draw)
    found = settle(field, field.clip_head(), codes, features)
    before, after = error(field, codes, features), error(field, found, features)
    assert (after <= before + 1e-5).all() and (after < before - 1e-4).float().mean() > 0.7


def test_a_code_close_by_is_found_again():
    field, draw = bumpy(3), torch.Generator().manual_seed(2)
    codes = torch.randn(300, 3, generator=draw)
    features = field.decode_clip(codes).detach()
    start = codes + 0.01 * torch.randn(300, 3, generator=draw)
    found = settle(field, field.clip_head(), start, features)
    assert error(field, found, features).median() < 0.01 * error(field, start, features).median()


def test_the_nearest_of_a_list_is_the_nearest():
    """All channels fit into the principal components that are compared."""
    field, draw = bumpy(3), torch.Generator().manual_seed(3)
    codes, features = torch.randn(50, 3, generator=draw), torch.randn(80, CHANNELS, generator=draw)
    decoded = field.decode_clip(codes).detach()
    expected = codes[torch.cdist(features, decoded).argmin(1)]
    assert torch.equal(nearest(field, field.clip_head(), codes, features), expected)


def test_searching_in_a_basis_is_searching_there():
    """Coordinates in an orthonormal basis have the distances of the features themselves."""
    field, draw = bumpy(3), torch.Generator().manual_seed(4)
    weight, bias = (part.detach() for part in field.clip_head())
    axes, _ = torch.linalg.qr(torch.randn(CHANNELS, CHANNELS, generator=draw))
    codes, features = torch.randn(40, 3, generator=draw), torch.randn(40, CHANNELS, generator=draw)
    plain = settle(field, (weight, bias), codes, features)
    turned = settle(field, (axes.T @ weight, bias @ axes), codes, features @ axes)
    gap = F.pairwise_distance(field.decode_clip(plain), field.decode_clip(turned)).detach()
    assert gap.median() < 1e-3
