"""Optional components: what a model and its checkpoint hold with and without them."""

import pytest

from lang3dxl_ns.plugin.optional_components import (
    build_camera_refinement,
    build_lighting,
    build_semantics,
    build_sky,
    component_parameters,
    leave_out_components,
)

PARTS = {
    build_sky: {"sky"},
    build_camera_refinement: {"camera_optimizer"},
    build_semantics: {"semantic_field", "downsampler", "clip_mean", "dense_mean"},
    build_lighting: {"appearance"},
}
"""Names in a checkpoint by component."""


def parts(model) -> set[str]:
    names = {name.split(".")[0] for name in model.state_dict()}
    return names & set().union(*PARTS.values())


@pytest.fixture
def model(train, scene):
    """One with semantics learned from renderings, a smooth sky, and refined cameras."""
    changes = {
        "pipeline__model__appearance__use": "off",
        "pipeline__model__sky_gaussians": 50,
        "pipeline__model__camera_optimization": "on",
        "pipeline__model__decoder__name": "paper",
    }
    return train(scene, iterations=1, **changes).pipeline.model


def test_every_component_can_be_left_out_and_built_again_under_the_names_of_checkpoints(model):
    assert parts(model) == set().union(*PARTS.values()) - PARTS[build_lighting]
    for build, names in PARTS.items():
        model.register_buffer("clip_mean", None), model.register_buffer("dense_mean", None)
        leave_out_components(model)
        model.config.camera_optimizer.mode = "off"
        assert parts(model) == set() and set(model.get_param_groups()) <= set(model.gauss_params)
        assert not component_parameters(model)
        build(model)
        assert parts(model) == names
        assert component_parameters(model)
