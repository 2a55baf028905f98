"""Laws of the appearance field: what it may change, and the photos' vectors."""

import io
import math
from dataclasses import replace

import pytest
import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.appearance import AppearanceConfig, AppearanceField
from lang3dxl_ns.rendering import Gaussians

NAMES = ["a.jpg", "b.jpg", "c.jpg"]


def make_field(names=NAMES, trained=False, scale=1.0, seed=0, **settings) -> AppearanceField:
    """In float64; `trained` gives the weights arbitrary values, as after training."""
    config = AppearanceConfig(**settings)
    generator = torch.Generator().manual_seed(seed)
    field = AppearanceField(config, names, torch.tensor([1.0, -2.0, 0.5]) * scale, scale, generator=generator)
    if trained:
        with torch.no_grad():
            field.output.weight.normal_(0, 0.3, generator=generator)
            field.grid.table.normal_(0, 0.3, generator=generator)
    return field.double()


def make_cloud(n=40, seed=1):
    """Gaussians in, around and far outside the scene, and their colors; away from all bounds."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(n, 3, generator=generator).double() * torch.logspace(-1, 2, n)[:, None]
    colors, opacities = torch.rand(n, 3, generator=generator), torch.rand(n, generator=generator)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(n, 4)
    return Gaussians(means, quats, torch.ones(n, 3), 0.3 + 0.4 * opacities.double()), 0.5 + colors.double()


def shine(field, cloud, name="a.jpg", visible=None, seed=None):
    """Colors and opacities under a photo's look."""
    gaussians, colors = cloud
    visible = torch.arange(len(colors)) if visible is None else torch.tensor(visible, dtype=torch.long)
    colors, gaussians = field(gaussians, colors, field.vector(name), visible, seed)
    return colors, gaussians.opacities


def test_untrained_field_changes_nothing():
    field, (gaussians, colors) = make_field(), make_cloud()
    shifted, same = field(gaussians, colors, field.vectors[0], torch.arange(len(colors)))
    assert torch.equal(shifted, colors) and same is gaussians


def test_two_lights_are_learned_with_eighty_views_of_each():
    """Photo b is photo a at half the brightness, and bluish on one side of the scene."""
    field, cloud = make_field(), make_cloud(100)
    evening = 0.5 * cloud[1] + (cloud[0].means[:, :1] > 0) * torch.tensor([0, 0, 0.2])
    targets = {"a.jpg": cloud[1], "b.jpg": evening}
    optimizer = torch.optim.Adam(field.parameters(), lr=5e-3, eps=1e-15)
    for _ in range(80):
        for name, target in targets.items():
            optimizer.zero_grad()
            (shine(field, cloud, name)[0] - target).abs().mean().backward()
            optimizer.step()
    for name, target in targets.items():
        assert float((shine(field, cloud, name)[0] - target).abs().mean().detach()) < 0.06


def test_only_visible_gaussians_change():
    field, cloud = make_field(trained=True, opacity_shift=True), make_cloud()
    before = cloud[1], cloud[0].opacities
    some, every = shine(field, cloud, visible=[3, 17], seed=5), shine(field, cloud, seed=5)
    hidden = [row for row in range(40) if row not in (3, 17)]
    for old, now, then in zip(before, some, every, strict=True):
        assert torch.equal(now[hidden], old[hidden])
        torch.testing.assert_close(now[[3, 17]], then[[3, 17]])
        assert not torch.equal(now[[3, 17]], old[[3, 17]])
    nothing = shine(field, cloud, visible=[], seed=5)
    assert torch.equal(nothing[0], before[0]) and torch.equal(nothing[1], before[1])


def test_no_gradient_reaches_the_places():
    field, cloud = make_field(trained=True), make_cloud()
    cloud[0].means.requires_grad_()
    shine(field, cloud)[0].sum().backward()
    assert cloud[0].means.grad is None


def test_units_of_the_world_do_not_matter():
    gaussians, colors = make_cloud()
    small, large = make_field(trained=True), make_field(trained=True, scale=1000.0)
    magnified = replace(gaussians, means=1000 * gaussians.means, scales=1000 * gaussians.scales)
    torch.testing.assert_close(shine(small, (gaussians, colors)), shine(large, (magnified, colors)))


def test_every_place_has_a_coordinate_of_its_own_inside_the_unit_cube():
    field = make_field()
    direction = torch.tensor([[0.36, 0.48, -0.8]]).double()
    distances = torch.tensor([0.0, 0.3, 0.999, 1.0, 1.001, 5.0, 20.0, 1e6]).double()[:, None]
    coordinates = field._unit_cube(field.center + distances * direction)
    assert (coordinates >= 0).all() and (coordinates <= 1).all()
    assert ((coordinates - 0.5).norm(dim=1).diff() > 0).all()
    # Inside the scene, lengths keep their ratios.
    assert float((coordinates[1] - 0.5).norm()) == pytest.approx(0.3 / 4)


def test_colors_and_opacities_stay_in_their_range():
    field, cloud = make_field(trained=True, opacity_shift=True), make_cloud()
    with torch.no_grad():
        field.output.bias.copy_(torch.tensor([-3.0, 0.0, 3.0, 9.0]))
    for seed in (None, 0):
        colors, opacities = shine(field, cloud, seed=seed)
        assert (colors >= 0).all() and (colors == 0).any()
        assert (opacities >= 0).all() and (opacities <= 1).all() and (opacities == 0).any()


# ── opacity shift ───────────────────────────────────────────────────────────────────────────────────


def test_untrained_opacity_shift_takes_out_few_gaussians_and_none_without_noise():
    field, cloud = make_field(opacity_shift=True), make_cloud(1000)
    before = cloud[0].opacities
    for seed in range(20):
        assert float((shine(field, cloud, seed=seed)[1] < 0.5 * before).double().mean()) < 0.05
    torch.testing.assert_close(shine(field, cloud)[1], before)


def test_noise_is_drawn_for_every_gaussian_and_again_for_every_seed():
    field, cloud = make_field(opacity_shift=True), make_cloud(1000)
    with torch.no_grad():
        field.output.bias[3] = 4.0  # an even chance
    taken = [shine(field, cloud, seed=seed)[1] < 0.1 for seed in (0, 1, 0)]
    assert 0.4 < float(taken[0].double().mean()) < 0.6
    assert torch.equal(taken[0], taken[2]) and not torch.equal(taken[0], taken[1])


@pytest.mark.parametrize("logit", [-2.0, 1.0])
def test_chance_of_being_taken_out_is_the_sigmoid_of_the_output(logit):
    field, (gaussians, colors) = make_field(opacity_shift=True), make_cloud(20_000)
    with torch.no_grad():
        field.output.bias[3] = logit + 4.0
    opaque = replace(gaussians, opacities=torch.ones_like(gaussians.opacities))
    left = shine(field, (opaque, colors), seed=0)[1]
    assert float((left < 0.5).double().mean()) == pytest.approx(1 / (1 + math.exp(-logit)), abs=0.01)


# ── photos ──────────────────────────────────────────────────────────────────────────────────────────


def saved(field):
    """The field's state after a round trip through a checkpoint, read safely."""
    file = io.BytesIO()
    torch.save(field.state_dict(), file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def test_vectors_stay_with_their_names():
    first = make_field()
    first.remember("c.jpg", torch.ones(3), torch.tensor([0.0, 1.0, 0.0]))
    second = make_field(["new.jpg", "c.jpg", "a.jpg", "z.jpg"], seed=9)
    fresh = {name: second.vector(name).detach().clone() for name in ("new.jpg", "z.jpg")}
    second.load_state_dict(saved(first))
    for name in NAMES:
        assert torch.equal(second.vector(name), first.vector(name))
    for name, vector in fresh.items():
        assert torch.equal(second.vector(name), vector)
    assert torch.equal(second.vector_of_view(torch.zeros(3), torch.ones(3)), first.vector("c.jpg"))
    third = make_field([])
    third.load_state_dict(saved(second))
    assert third.names == [*NAMES, "new.jpg", "z.jpg"]


def test_loading_keeps_the_parameter_that_the_optimizer_holds():
    first, second = make_field(), make_field(["new.jpg"])
    parameter = second.vectors
    second.load_state_dict(saved(first))
    assert second.vectors is parameter and parameter.shape == (4, 24)


def test_unknown_look_names_the_photos():
    with pytest.raises(UserError, match=r"dusk\.jpg is not a training photo .* a\.jpg, b\.jpg"):
        make_field().vector("dusk.jpg")


def learned_field(unseen, scale=1.0):
    """Photo a is at the origin, b beside it and turned around, c far away; d was never trained."""
    field = make_field([*NAMES, "d.jpg"], unseen=unseen)
    poses = {"a.jpg": (0.0, 1.0), "b.jpg": (1.0, -1.0), "c.jpg": (10.0, 1.0)}
    for name, (x, z) in poses.items():
        field.remember(name, torch.tensor([x, 0.0, 0.0]) * scale, torch.tensor([0.0, 0.0, z]))
    return field


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_nearest_takes_the_camera_that_stands_and_looks_alike(scale):
    field = learned_field("nearest", scale)
    views = {"a.jpg": (0.0, 1.0), "b.jpg": (1.0, -1.0), "c.jpg": (9.0, 1.0)}
    views_between = {"a.jpg": (0.9, 1.0), "b.jpg": (0.1, -1.0)}
    views_outside = {"a.jpg": (-2.0, 1.0), "c.jpg": (14.0, -1.0)}
    for expected in (views, views_between, views_outside):
        for name, (x, z) in expected.items():
            view = torch.tensor([x, 0.0, 0.0]) * scale, torch.tensor([0.0, 0.0, z])
            assert torch.equal(field.vector_of_view(*view), field.vector(name)), (name, x, z)


def test_mean_is_of_the_photos_that_were_learned():
    field = learned_field("mean")
    vector = field.vector_of_view(torch.zeros(3), torch.ones(3))
    torch.testing.assert_close(vector, field.vectors[:3].mean(0))


@pytest.mark.parametrize("unseen", ["nearest", "mean"])
def test_before_any_training_every_view_has_the_zero_vector(unseen):
    field = make_field(unseen=unseen)
    assert not field.vector_of_view(torch.zeros(3), torch.ones(3)).any()
