"""Optional parts: what a checkpoint holds with and without them."""

from dataclasses import replace

import pytest

from lang3dxl_ns.training.parts import Parts

NAMES = {
    "sky": {"sky"},
    "cameras": {"camera_optimizer"},
    "semantics": {"semantic_field", "downsampler", "clip_mean", "dense_mean"},
    "appearance": {"appearance"},
}
"""Names in a checkpoint by part."""


def parts_in(state) -> set[str]:
    return {name.split(".")[0] for name in state} & set().union(*NAMES.values())


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


def test_every_part_can_be_left_out_and_comes_back_with_its_checkpoint(model):
    run = model.run
    assert parts_in(model.state_dict()) == set().union(*NAMES.values()) - NAMES["appearance"]
    assert run.tensors().keys() == model.state_dict().keys() - {"device_indicator_param"}
    state = run.tensors()
    for name in ("sky", "cameras", "semantics"):
        without = {k: v for k, v in state.items() if k.split(".")[0] not in NAMES[name]}
        assert parts_in(state) - parts_in(without) == NAMES[name]
        run.parts = replace(run.parts, **{name: None})
        assert not NAMES[name] & parts_in(run.tensors())
        run.load(state)
        assert parts_in(run.tensors()) == parts_in(state)
    run.parts = Parts()
    assert run.groups().keys() <= run.gaussians.keys()
