"""Laws of the attenuated downsampler."""

import math

import numpy as np
import pytest
import torch
from downsampler_by_loops import dense_kernel, reference_mean

from lang3dxl_ns.components.downsampler import (
    AttenuatedDownsampler,
    DownsamplerConfig,
    mean_with_one_maximum,
    mean_with_window_maxima,
    separable_kernel,
)

KERNELS = ["pyramid", "box"]
CPU = torch.device("cpu")
# (map, grid, crop sides): plain; map below the grid; one cell; crops wider than the map; same size.
CASES = [
    ((11, 9), (6, 5), (0.4, 0.55, 0.8)),
    ((4, 5), (7, 8), (0.25, 0.5)),
    ((8, 6), (1, 1), (1.0,)),
    ((6, 10), (3, 5), (0.4, 1.0, 2.5)),
    ((7, 7), (7, 7), (2 / 7,)),
]


def seeded(*size, seed=0):
    return torch.randn(*size, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def downsampler(kernel="pyramid", hidden=0, bound=10.0, channels=4, trained=False):
    module = AttenuatedDownsampler(
        DownsamplerConfig(kernel, hidden, bound), channels, generator=torch.Generator().manual_seed(0)
    ).double()
    if trained:
        module.network[-1].weight.data = seeded(*module.network[-1].weight.shape)
    return module


@pytest.mark.parametrize("mean", [mean_with_one_maximum, mean_with_window_maxima])
@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize(("size", "grid", "sides"), CASES)
def test_the_mean_equals_a_loop_over_every_pixel_of_every_window(name, size, grid, sides, mean):
    features, logits = seeded(*size, 3), 3 * seeded(*size, seed=1)
    mask = (seeded(*size, seed=2) > 0).double()
    kernel = separable_kernel(name, size, grid, sides, torch.float64, CPU)
    expected = reference_mean(dense_kernel(name, size, grid, sides), features, logits, mask)
    torch.testing.assert_close(mean(kernel, features, logits, mask), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize(("size", "grid", "sides"), CASES)
def test_the_share_is_the_kernel_weight_on_the_mask(name, size, grid, sides):
    mask = seeded(*size, seed=2) > 0
    share = downsampler(name)(seeded(*size, 4), grid, sides, mask)[1]
    expected = (dense_kernel(name, size, grid, sides) * mask).sum((2, 3))
    torch.testing.assert_close(share, expected, rtol=0, atol=1e-8)
    assert float(downsampler(name)(seeded(*size, 4), grid, sides)[1].max()) <= 1 + 1e-12


@pytest.mark.parametrize("hidden", [0, 3])
@pytest.mark.parametrize("bound", [10.0, None])
@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize(("size", "grid", "sides"), CASES)
def test_a_constant_map_stays_constant_up_to_its_borders_and_under_any_mask(
    name, size, grid, sides, hidden, bound
):
    module = downsampler(name, hidden, bound, trained=hidden > 0)
    constant = torch.tensor([1.0, -2.0, 30.0, 0.0], dtype=torch.float64)
    for mask in (None, seeded(*size, seed=2) > 0, seeded(*size, seed=3).sigmoid()):
        result, share = module(constant.expand(*size, 4), grid, sides, mask)
        expected = constant.expand(*grid, 4) * (share > 0)[..., None]
        torch.testing.assert_close(result, expected, rtol=0, atol=1e-10)


def ramp_and_error(name, size, grid, sides):
    """Distance of each cell's mean pixel position from the cell's center, as a fraction of the image."""
    positions = [
        torch.cartesian_prod(*((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in shape)).view(
            *shape, 2
        )
        for shape in (size, grid)
    ]
    result, share = downsampler(name, channels=2)(positions[0], grid, sides)
    return (result - positions[1]).norm(dim=-1), share > 1 - 1e-9


@pytest.mark.parametrize("name", ["pyramid", "box"])
@pytest.mark.parametrize("rho", [1, 5, 15])
def test_a_ramp_keeps_its_position_where_the_window_is_inside(name, rho):
    """Exactly, for any ratio of map to grid. A window over the edge lacks that part, so its mean
    lies at the middle of the rest: the target's crops are black out there too."""
    error, inside = ramp_and_error(name, (80, 100), (48, 61), [2 / 61, 2 / 61 * rho])
    assert inside.sum() > 500
    assert float(error[inside].max()) < 1e-12


def test_the_pyramid_weighs_its_nested_squares_by_the_published_factor():
    kernel = separable_kernel("pyramid", (99, 99), (1, 1), (16 / 99, 64 / 99), torch.float64, CPU)
    weight = torch.einsum("jap,jaq->pq", kernel.rows, kernel.columns)
    center = 49
    # Distances on the axis between the half sides 8, 11.3, 16, 22.6, 32 of the five squares.
    ring = [float(weight[center, center + d]) for d in (0, 9, 13, 19, 27)]
    steps = [a - b for a, b in zip(ring, [*ring[1:], 0.0], strict=True)]
    np.testing.assert_allclose(np.array(steps) / steps[0], [(2 * math.sqrt(2)) ** -j for j in range(5)])


# ------------------------------------------------------------------ logits


@pytest.mark.parametrize("bound", [10.0, 60.0, None])
def test_every_choice_of_bound_gives_the_mean_of_its_own_logits(bound):
    size, grid, sides = CASES[0]
    module = downsampler("pyramid", 3, bound, trained=True)
    features = 20 * seeded(*size, 4)
    logits = module.logits(features)
    largest = logits.detach().abs().max()
    assert largest > 60 if bound is None else largest <= bound
    ones = torch.ones(size, dtype=torch.float64)
    expected = reference_mean(dense_kernel("pyramid", size, grid, sides), features, logits, ones)
    torch.testing.assert_close(module(features, grid, sides)[0], expected, rtol=0, atol=1e-9)
    single = module.float()(features.float(), grid, sides)[0]
    torch.testing.assert_close(single.double(), expected, rtol=1e-3, atol=1e-2)


# ------------------------------------------------------------------ masks


@pytest.mark.parametrize(("hidden", "bound"), [(0, 10.0), (3, 10.0), (3, None)])
def test_features_off_the_mask_have_no_influence(hidden, bound):
    module = downsampler("pyramid", hidden, bound, trained=hidden > 0)
    features, mask = seeded(12, 20, 4), seeded(12, 20, seed=1) > 0
    other = torch.where(mask[..., None], features, 100 * seeded(12, 20, 4, seed=2))
    results = [module(f, (6, 10), (0.2, 0.4), mask)[0] for f in (features, other)]
    torch.testing.assert_close(*results)


def test_a_soft_mask_weighs_pixels_once():
    size, grid, sides = CASES[0]
    soft = seeded(*size, seed=2).sigmoid()
    plain = downsampler("pyramid", 0)(seeded(*size, 4), grid, sides, soft)
    for bound in (10.0, None):
        started = downsampler("pyramid", 3, bound)(seeded(*size, 4), grid, sides, soft)
        torch.testing.assert_close(started, plain)


# ------------------------------------------------------------------ the module


@pytest.mark.parametrize(
    ("preset", "kernel", "hidden"),
    [(None, "pyramid", 16), ("short", "pyramid", 16), ("paper", "box", 512), ("official", "pyramid", 512)],
)
def test_published_presets_have_the_published_downsampler(preset, kernel, hidden):
    found = DownsamplerConfig().resolved(preset)
    assert (found.kernel, found.hidden) == (kernel, hidden)
    asked = DownsamplerConfig("box", 8)
    assert asked.resolved(preset) == asked


def test_without_hidden_width_there_is_nothing_to_train():
    assert list(downsampler(hidden=0).parameters()) == []
    assert (downsampler(hidden=0).logits(seeded(3, 3, 4)) == 0).all()


@pytest.mark.parametrize("name", KERNELS)
def test_training_starts_from_the_plain_kernel_mean_and_can_leave_it(name):
    features = seeded(12, 20, 4)
    module = downsampler(name, 3)
    started, plain = (m(features, (6, 10), (0.2, 0.4))[0] for m in (module, downsampler(name, 0)))
    torch.testing.assert_close(started, plain)
    started.square().sum().backward()
    assert module.network[-1].weight.grad.abs().max() > 0


def test_the_generator_alone_decides_the_weights():
    torch.manual_seed(1)
    state = torch.get_rng_state()
    first, second = downsampler(hidden=3), downsampler(hidden=3)
    assert torch.equal(torch.get_rng_state(), state)
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_kernel_cached_in_inference_mode_serves_training():
    features, sides = seeded(13, 17, 4), (0.21,)
    with torch.inference_mode():
        downsampler()(features, (6, 10), sides)
    downsampler()(features.requires_grad_(), (6, 10), sides)[0].sum().backward()
    assert features.grad.abs().max() > 0


def test_the_result_has_the_type_of_the_features():
    for dtype in (torch.float32, torch.float64):
        module = downsampler(hidden=3).to(dtype)
        assert {t.dtype for t in module(seeded(12, 20, 4).to(dtype), (6, 10), (0.2,))} == {dtype}


@pytest.mark.parametrize("sides", [(), (0.0, 0.1), (0.4, 0.2)])
def test_crop_sides_that_are_not_positive_and_ascending_are_refused(sides):
    with pytest.raises(ValueError, match="smallest first"):
        downsampler()(seeded(5, 5, 4), (2, 2), sides)


def test_the_ablations_resize_to_the_other_grid_and_keep_a_ramp():
    ramp = ((torch.arange(40, dtype=torch.float64) + 0.5) / 40).expand(30, 40)[..., None]

    def matched(match, target):
        module = AttenuatedDownsampler(DownsamplerConfig(hidden=0, match=match), 1).double()
        return module.match(ramp, target, (0.2,))

    low = matched("resize-features", torch.zeros(15, 16, 1).double())[0]
    torch.testing.assert_close(low[3, :, 0], (torch.arange(16, dtype=torch.float64) + 0.5) / 16)
    high = matched("resize-target", low)[1]
    torch.testing.assert_close(high[:, 2:-2], ramp[:, 2:-2])


def test_features_and_target_meet_on_the_grid_that_is_asked_for():
    features, target, sides = seeded(24, 32, 4), seeded(6, 8, 4), (0.2,)
    for match, grid in (("attenuated", (6, 8)), ("resize-features", (6, 8)), ("resize-target", (24, 32))):
        module = AttenuatedDownsampler(DownsamplerConfig(hidden=3, match=match), 4).double()
        found, wanted, weight = module.match(features, target, sides)
        assert found.shape == wanted.shape == (*grid, 4)
        assert weight.shape == grid
        assert (module.network is None) is (match != "attenuated")


def test_resized_features_are_those_inside_the_mask():
    module = AttenuatedDownsampler(DownsamplerConfig(match="resize-features"), 2)
    features = torch.full((12, 12, 2), 3.0)
    mask = torch.ones(12, 12, dtype=torch.bool)
    features[:, :5], mask[:, :5] = 100.0, False
    found, _, weight = module.match(features, torch.zeros(5, 5, 2), (0.3,), mask)
    torch.testing.assert_close(found[weight > 0], torch.full_like(found[weight > 0], 3.0))
    assert (found[weight == 0] == 0).all() and (weight == 0).any()
