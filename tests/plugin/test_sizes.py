"""Memory and time of training: the estimates, and the number of Gaussians that fit."""

from dataclasses import replace

import pytest
import torch

from lang3dxl_ns.plugin import trainer as trainers
from lang3dxl_ns.plugin.sizes import Sizes, plan, sizes_of

SIZES = Sizes(numbers=62, network=6_000_000, pixels=700_000, looks=False, codes=0, decoded=0, on_gpu=False)


@pytest.mark.parametrize("gaussians", [1, 1_000, 3_000_000])
def test_as_many_gaussians_fit_as_the_memory_was_estimated_for(gaussians):
    assert abs(SIZES.most(SIZES.memory(gaussians)) - gaussians) <= 1


def test_every_part_takes_memory():
    least = SIZES.memory(1000)
    for more in (
        {"looks": True},
        {"codes": 3},
        {"decoded": 10_000},
        {"pixels": 10**6},
        {"network": 10**7},
        {"on_gpu": True},
    ):
        assert replace(SIZES, **more).memory(1000) > least


def test_the_present_gaussians_are_kept_and_a_wish_is_obeyed(monkeypatch):
    monkeypatch.setattr("lang3dxl_ns.plugin.sizes.memory_to_plan_with", lambda device: 1e6)  # too little
    device = torch.device("cpu")
    assert plan(SIZES, device, now=5_000, wanted=None)[0] == 5_000
    assert plan(SIZES, device, now=5_000, wanted=70)[0] == 70
    most, message = plan(SIZES, device, now=5_000, wanted=0)
    assert most == 0 and "no limit" in message


def test_semantics_count_where_they_are_trained(scene, train):
    gathered = train(scene, iterations=1).pipeline.model
    trained = train(scene, iterations=1, pipeline__model__encoder__name="paper").pipeline.model
    assert (sizes_of(gathered, 100, False).codes, sizes_of(gathered, 100, False).decoded) == (0, 0)
    channels = len(trained.clip_mean) + len(trained.dense_mean)
    assert sizes_of(trained, 100, False).codes == 3
    assert sizes_of(trained, 100, False).decoded == 72**2 * channels


def test_the_time_of_training_is_told_before_it_and_telling_changes_nothing(scene, train, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(trainers.CONSOLE, "log", said.append)
    ticks = iter(range(1000))
    monkeypatch.setattr(trainers, "perf_counter", lambda: next(ticks))  # a rendering takes a second
    trainer = train(scene, iterations=2)
    assert [line for line in said if "Gaussians multiply" in line] == [
        "training: about 10 seconds for 2 iterations, more if Gaussians multiply"
    ]
    model, random = trainer.pipeline.model.train(), torch.get_rng_state()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    trainer.config.max_num_iterations = 3000
    trainer._announce_time()
    assert "about 2.5 hours for 3,000 iterations" in said[-1]
    assert torch.equal(torch.get_rng_state(), random) and model.training
    torch.testing.assert_close(dict(model.state_dict()), before, rtol=0, atol=0, equal_nan=True)
