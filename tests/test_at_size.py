"""At real size: eight threads, photos of 12 megapixels, a million Gaussians. Each in a process of its own."""

import resource

import pytest
import torch
from processes import Process


def on_eight_threads() -> None:
    """All kernels of a step and of gathering, with one thread and with eight."""
    from lang3dxl_ns.common import jit
    from lang3dxl_ns.components.field_settings import SemanticFieldConfig
    from lang3dxl_ns.components.losses import rgb_loss
    from lang3dxl_ns.components.semantic_field import SemanticField
    from lang3dxl_ns.rendering import Gaussians, rasterize
    from lang3dxl_ns.scene.camera import Camera

    draw = torch.Generator().manual_seed(0)
    means = torch.rand(20_000, 3, generator=draw) - torch.tensor([0.5, 0.5, -1.5])
    shape = torch.randn(20_000, 4, generator=draw), torch.full((20_000, 3), 0.01), torch.full((20_000,), 0.6)
    lens = torch.tensor([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])
    field = SemanticField(SemanticFieldConfig("short"), 16, generator=draw)
    found = []
    for threads in (1, 8):
        torch.set_num_threads(threads)
        colors = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(1)).requires_grad_()
        means = means.detach().requires_grad_()
        image = rasterize(Gaussians(means, *shape), Camera(torch.eye(4), lens, 320, 240), colors).image
        loss = rgb_loss(image, torch.full_like(image, 0.5)) + field.decode_clip(colors).square().mean()
        found.append([image.detach(), *torch.autograd.grad(loss, [means, colors, field.grid.table])])
    for one, eight in zip(*found, strict=True):
        torch.testing.assert_close(one, eight, rtol=1e-3, atol=1e-5)
    assert jit._pool.cache_info().currsize == 1, "more than one pool of threads was made"


def of_large_photos(folder, clip, dense) -> None:
    from runs import train_run
    from scenes import write_scene

    data = write_scene(folder / "scene", photos=3, points=200, size=(4000, 3000), coarseness=4)
    scale = {"pipeline__datamanager__camera_res_scale_factor": 0.4}
    trainer = train_run(data, clip, dense, folder / "runs", 3, **scale)
    assert trainer.pipeline.model.gauss_params["codes"].isfinite().any()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 4e9 / 1024


def of_a_million_gaussians() -> None:
    from lang3dxl_ns.components.compression import CompressedField, centered_cosine
    from lang3dxl_ns.components.feature_decoder import Gathered
    from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig
    from lang3dxl_ns.query.doubt import UNRELATED, Doubts
    from lang3dxl_ns.query.engine import make_engine
    from lang3dxl_ns.query.relevancy import Queries

    count, channels, draw = 1_000_000, 24, torch.Generator().manual_seed(0)
    kinds = torch.randn(16, channels, generator=draw)
    owner = torch.arange(count) % 16
    features = kinds[owner] + 0.1 * torch.randn(count, channels, generator=draw)
    field = CompressedField(SemanticFieldConfig("short"), channels, CompressionConfig(100, 512, sample=1_000))
    seen = torch.rand(count, generator=draw) < 0.03  # a code is searched for each of these alone
    codes = field.learn_gaussians(Gathered(features, seen.float()))
    assert bool((codes.isfinite().all(1) == seen).all())
    assert centered_cosine(Gathered(features[seen], seen[seen].float()), field, codes[seen]) > 0.95
    engine = make_engine(field, codes)
    queries = Queries.of(kinds[:2, None].unbind(), kinds[5:9])
    relevancy = engine.of_gaussians(queries)
    assert (relevancy[0][(owner == 0) & seen] > 0.5).float().mean() > 0.99
    words = {text: torch.randn(1, channels, generator=draw) for text in UNRELATED}
    doubts = Doubts(
        engine.of_gaussians, lambda texts: Queries.of([words[text] for text in texts], kinds[5:9])
    )
    assert doubts.of(relevancy)[0] < 0.1
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 4e9 / 1024


def of_things_among_a_million_gaussians() -> None:
    """Twelve painted walls, one behind the other, in twelve photos of 960 pixels a side."""
    import time
    from dataclasses import replace

    from painted_scene import painted_codes, painted_file, painted_scene, painted_splats, photo

    from lang3dxl_ns.rendering import Splats

    walls, ticks = 12, 48
    plain = painted_splats(ticks)
    means = torch.cat([plain.means + torch.tensor([0.0, 0.0, 0.1 * wall]) for wall in range(walls)])
    others = (plain.quats, plain.scales, plain.opacities, plain.harmonics)
    splats = Splats(means, *(values.repeat(walls, *[1] * (values.dim() - 1)) for values in others))
    photos = [photo(f"{n}.jpg", 0.2 * n - 1, 0.1 * n - 1, focal=960, size=960) for n in range(walls)]
    codes, file = painted_codes(ticks).repeat(walls, 1), replace(painted_file(), photos=photos)
    scene = painted_scene(splats=splats, codes=codes, file=file)
    assert len(splats) > 990_000
    scene.mass  # noqa: B018 — measured once per scene, at the first query
    start = time.process_time()
    found = scene.things(["windows", "domes", "towers", "portals", "spires", "minarets"])
    taken, memory = time.process_time() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"{taken:.0f} s of processor, {1024 * memory / 1e9:.1f} GB")
    assert [len(one.things) for one in found[:2]] == [2, 1]
    assert taken < 30 and memory < 2e9 / 1024


def passes(function, *arguments) -> None:
    done = Process(function, *arguments).wait(1800)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    print(done.stdout)


def test_eight_threads_give_what_one_gives_from_one_pool():
    passes(on_eight_threads)


@pytest.mark.slow
@pytest.mark.nerfstudio
def test_words_are_learned_from_photos_of_12_megapixels_in_4_gigabytes(tmp_path, tiny_clip, tiny_dense):
    passes(of_large_photos, tmp_path, tiny_clip, tiny_dense)


@pytest.mark.slow
def test_a_million_gaussians_are_compressed_and_asked():
    passes(of_a_million_gaussians)


@pytest.mark.slow
def test_things_are_found_among_a_million_gaussians():
    passes(of_things_among_a_million_gaussians)
