"""Relevancy of Gaussians by a product with few numbers each is that of their decoded features."""

import pytest
import torch
import torch.nn.functional as F

from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.query.engine import PerGaussian, make_engine
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.rendering import Gaussians, rasterize
from lang3dxl_ns.scene.camera import Camera


def decoder(channels: int) -> CompressedField:
    torch.manual_seed(0)
    field = CompressedField(SemanticFieldConfig("short"), channels)
    field.grid.table.data.normal_(std=0.3)
    field.output_mean.normal_(std=0.3)
    return field


def queries(channels: int) -> Queries:
    generator = torch.Generator().manual_seed(1)
    vectors = torch.randn(6, channels, generator=generator)
    return Queries.of([vectors[:1], vectors[1:3]], vectors[3:])


@pytest.mark.parametrize("channels", [16, 65, 512, 1152])
def test_the_low_rank_product_is_the_full_one(channels):
    """Narrower and wider than the hidden layer; 16 bits cost less than 1e-3."""
    field, asked = decoder(channels), queries(channels)
    codes = torch.randn(500, 3)
    features = PerGaussian.of(field, codes)
    assert features.rows.shape[1] <= 65
    exact = F.normalize(field.double().decode_clip(codes.double()), dim=1) @ asked.vectors.double().T
    torch.testing.assert_close(features.cosines(asked).double(), exact.detach(), atol=1e-3, rtol=0)


def test_what_is_unknown_answers_nothing_and_changes_nothing():
    field, asked = decoder(512), queries(512)
    codes = torch.randn(20, 3)
    alone = PerGaussian.of(field, codes).of_gaussians(asked)
    codes = torch.cat([codes, torch.full((2, 3), torch.nan)])
    features = PerGaussian.of(field, codes)
    found = features.of_gaussians(asked)
    assert features.known.tolist() == [True] * 20 + [False] * 2
    assert (found[:, -2:] == 0).all()
    torch.testing.assert_close(found[:, :-2], alone, atol=1e-3, rtol=0)


def test_features_that_all_but_vanish_say_nothing(monkeypatch):
    """A row divided by such a feature's length is beyond half precision."""
    field = decoder(512)
    weight, bias = field.clip_head()
    monkeypatch.setattr(field, "clip_head", lambda: (weight * 1e-9, bias * 1e-9))
    features = PerGaussian.of(field, torch.randn(20, 3))
    assert features.rows.isfinite().all() and features.of_gaussians(queries(512)).isfinite().all()


def test_memory_for_decoding_changes_no_answer(monkeypatch):
    field, asked, codes = decoder(512), queries(512), torch.randn(300, 3)
    whole = PerGaussian.of(field, codes).of_gaussians(asked)
    monkeypatch.setattr("lang3dxl_ns.query.engine._CHUNK_MB", 0.05)
    parts = PerGaussian.of(field, codes).of_gaussians(asked)
    torch.testing.assert_close(parts, whole, atol=1e-3, rtol=0)  # 16 bits may round otherwise


def slab(count: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """A cloud of Gaussians before a camera, in float64."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    scales = 0.02 + 0.1 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    opacities = 0.2 + 0.7 * torch.rand(count, generator=generator, dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)
    view[2, 3] = 2.0
    intrinsics = torch.tensor([[30.0, 0, 16], [0, 31.0, 12], [0, 0, 1]], dtype=torch.float64)
    return Gaussians(means, quats, scales, opacities), Camera(view, intrinsics, 32, 24)


def map_of(engine, asked, gaussians, camera):
    carried = engine.channels(asked).double()
    drawn = rasterize(gaussians, camera, carried)
    return engine.maps(drawn.image, asked), drawn.alpha[..., 0]


def test_a_composited_relevancy_is_the_mean_of_the_gaussians_by_their_weight():
    """Weights by hand: what a Gaussian alone carries a 1 of is its contribution to every pixel."""
    gaussians, camera = slab(12)
    field, asked = decoder(64), queries(64)
    codes = torch.randn(12, 3)
    engine = make_engine(field, codes)
    maps, _ = map_of(engine, asked, gaussians, camera)
    weights = rasterize(gaussians, camera, torch.eye(12, dtype=torch.float64)).image
    exact = F.normalize(field.double().decode_clip(codes.double()), dim=1) @ asked.vectors.double().T
    reference = (weights @ asked.relevancy_of_cosines(exact.detach()).T).permute(2, 0, 1)
    torch.testing.assert_close(maps, reference, atol=2e-3, rtol=0)


def test_a_scene_of_one_material_says_the_same_wherever_it_is_seen():
    """Relevancy over coverage is one number: at edges, through haze, from the other side."""
    gaussians, camera = slab(60)
    engine = make_engine(decoder(64), torch.tensor([[0.3, -1.0, 0.7]]).expand(60, 3))
    asked = queries(64)
    expected = engine.of_gaussians(asked)[:, :1, None]
    behind = camera.view_matrix.clone()
    behind[:3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    for view in (camera, Camera(behind, camera.intrinsics, 32, 24)):
        maps, alpha = map_of(engine, asked, gaussians, view)
        assert (alpha > 0.01).sum() > 200 and (alpha < 0.5).any()
        torch.testing.assert_close(maps, expected.double() * alpha, atol=1e-6, rtol=1e-6)
