"""The sky: what trains it, and what it is outside training."""

import pytest
import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.sky import OPACITY, Sky
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.rendering import Gaussians
from lang3dxl_ns.training.gaussians import colors_seen, sphere_around

COUNT = 200
ONE_LIGHT = {"pipeline__model__appearance__use": "off"}


def some_gaussians(n=300) -> tuple[Gaussians, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    sizes = (n, 3), (n, 4), (n, 3), (n,)
    values = [torch.rand(*size, generator=generator, requires_grad=True) for size in sizes]
    return Gaussians(*values), torch.rand(n, 3, generator=generator, requires_grad=True)


def a_sky() -> Sky:
    return Sky(sphere_around(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), COUNT))


def test_no_gradient_moves_the_sky_and_others_keep_theirs():
    (gaussians, colors), sky = some_gaussians(), a_sky()
    kept, painted = sky(gaussians, colors)
    (sum(values.sum() for values in vars(kept).values()) + painted.sum()).backward()
    for values in (*vars(gaussians).values(), colors):
        assert not values.grad[:COUNT].any()
        assert (values.grad[COUNT:] == 1).all()
    assert sky.harmonics.grad[0].abs().min() > 0
    torch.testing.assert_close(painted[COUNT:], colors[COUNT:])


def test_one_smooth_function_reaches_directions_that_no_photo_shows():
    """Fitted on half of the sphere, a linear change of color is known on the other half too."""
    sky = a_sky()
    up = torch.nn.functional.normalize(sky.directions, dim=1)[:, 2:]
    wanted = (0.5 + 0.3 * up).expand(-1, 3)
    shown = sky.directions[:, 0] > 0
    optimizer = torch.optim.LBFGS([sky.harmonics], max_iter=100)

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        error = (sky.colors - wanted)[shown].square().sum()
        error.backward()
        return error

    optimizer.step(loss)
    torch.testing.assert_close(sky.colors, wanted, atol=1e-3, rtol=0)


def trained(train, scene, iterations=20, **changes) -> Lang3DXLModel:
    changes = {"pipeline__model__sky_gaussians": COUNT, **ONE_LIGHT, **changes}
    return train(scene, iterations=iterations, semantics=False, **changes).pipeline.model


def test_densification_grows_and_drops_others_alone(train, scene):
    """Even where there is hardly room for more than the sky."""
    grow = {"pipeline__model__densify_grad_thresh": 1e-7}
    for cap in (0, COUNT + 5):
        model = trained(train, scene, **grow, pipeline__model__max_gaussians=cap)
        assert model.num_points == COUNT + 5 if cap else model.num_points > COUNT + 400
        center = model.means.detach()[:COUNT] - model.sky.directions
        torch.testing.assert_close(center, center[:1].expand(COUNT, 3), atol=1e-4, rtol=0)
        assert (model.opacities.detach()[:COUNT].sigmoid() - OPACITY).abs().max() < 1e-6


def test_trained_it_is_gaussians_like_any_others(train, scene):
    """A view looks the same with and without what only training needs, harmonics of colors or none."""
    for view_dependence in ("on", "off"):
        model = trained(train, scene, pipeline__model__view_dependence=view_dependence).eval()
        model.run.step = 10_000
        dc, sky = model.gauss_params["features_dc"][:COUNT], model.sky.colors
        shown = colors_seen(model.gauss_params, model.run.degree, torch.zeros(3))[:COUNT]
        torch.testing.assert_close(shown, sky.clamp(1e-4, 1 - 1e-4), atol=1e-4, rtol=0)
        assert dc.std() > 0


@pytest.mark.parametrize(
    "changes", [{"pipeline__model__sky_gaussians": 0}, {"pipeline__model__appearance__use": "on"}]
)
def test_without_a_sky_and_with_looks_there_is_nothing_of_it(train, scene, changes):
    model = trained(train, scene, 1, **changes)
    assert model.sky is None and "sky" not in model.get_param_groups() and model.run.densification.still == 0
    assert not [name for name in model.state_dict() if name.startswith("sky")]


def test_a_resumed_run_trains_the_sky_that_it_began_with(train, scene):
    """Whatever number its settings have; without a sky they contradict the run."""
    first = train(scene, iterations=4, semantics=False, pipeline__model__sky_gaussians=COUNT, **ONE_LIGHT)
    place = {"load_dir": first.checkpoint_dir, "iterations": 8, "semantics": False, **ONE_LIGHT}
    again = train(scene, pipeline__model__sky_gaussians=50, **place).pipeline.model
    assert len(again.sky) == again.run.densification.still == COUNT
    assert not torch.equal(again.sky.harmonics, first.pipeline.model.sky.harmonics)
    with pytest.raises(UserError, match="was trained with sky, which the current settings leave out"):
        train(scene, pipeline__model__sky_gaussians=0, **place)


def test_a_checkpoint_brings_a_sky_of_its_own_size_or_none_as_before_it_was_smooth(train, scene):
    first = trained(train, scene)
    second = trained(train, scene, 1, pipeline__model__sky_gaussians=50)
    state = first.state_dict()
    second.load_state_dict(state, strict=True)
    torch.testing.assert_close(second.sky.colors, first.sky.colors)
    assert second.run.densification.still == COUNT
    without = {name: value for name, value in state.items() if not name.startswith("sky")}
    second.load_state_dict(without, strict=True)
    assert second.sky is None and second.run.densification.still == 0
