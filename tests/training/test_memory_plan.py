"""Memory and time of training: the estimates, and the number of Gaussians that fit."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from lang3dxl_ns.common.stages import roughly
from lang3dxl_ns.plugin import trainer as trainers
from lang3dxl_ns.training import estimate
from lang3dxl_ns.training import memory as sizes
from lang3dxl_ns.training.parts import Parts


@pytest.fixture
def model(scene, train):
    return train(scene, iterations=1).pipeline.model


def cap(model, memory, monkeypatch, pixels=700_000, wanted=None):
    monkeypatch.setattr(sizes, "memory_to_plan_with", lambda device: memory)
    model.run.settings.max_gaussians = wanted
    sizes.plan(model.run, [SimpleNamespace(width=pixels, height=1)])
    return model.run.densification.most


@pytest.mark.parametrize("gaussians", [10_000, 3_000_000])
def test_as_many_gaussians_fit_as_the_memory_was_estimated_for(model, monkeypatch, gaussians):
    fixed, each = sizes.bytes_of(model.run, 700_000)
    assert abs(cap(model, fixed + gaussians * each, monkeypatch) - gaussians) <= 1


def test_words_looks_and_pixels_take_memory(model, monkeypatch):
    most = cap(model, 8e9, monkeypatch)
    assert cap(model, 8e9, monkeypatch, pixels=12_000_000) < most
    run = model.run
    run.parts = replace(run.parts, appearance=torch.nn.Linear(2, 2))
    assert cap(model, 8e9, monkeypatch) < most
    run.parts = replace(run.parts, appearance=None, semantics=None)
    assert cap(model, 8e9, monkeypatch) > most


def test_sums_of_many_threads_are_planned_with(model, monkeypatch):
    most = cap(model, 8e9, monkeypatch)
    monkeypatch.setattr(sizes.torch, "get_num_threads", lambda: 64)
    assert cap(model, 8e9, monkeypatch) < most


def test_the_present_gaussians_are_kept_and_a_wish_is_obeyed(model, monkeypatch):
    assert cap(model, 1e6, monkeypatch) == model.num_points  # too little
    assert cap(model, 1e6, monkeypatch, wanted=70) == 70
    assert cap(model, 1e6, monkeypatch, wanted=0) == 0
    assert "no limit" in sizes.plan(model.run, [SimpleNamespace(width=10, height=10)])


def test_the_time_of_training_is_told_before_it_and_telling_changes_nothing(scene, train, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(trainers.CONSOLE, "log", said.append)
    ticks = iter(range(1000))
    monkeypatch.setattr(estimate, "perf_counter", lambda: next(ticks))  # a rendering takes a second
    trainer = train(scene, iterations=2)
    (line,) = (line for line in said if "Gaussians multiply" in line)
    photos = len(trainer.pipeline.datamanager.train_dataset)
    words = roughly(photos * estimate.RENDERINGS_PER_PHOTO + 0.1)
    start = f"training: about 10 seconds for 2 iterations, then {words} to learn words"
    assert line == f"{start}, more if Gaussians multiply"
    model, random = trainer.pipeline.model.train(), torch.get_rng_state()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    trainer.config.max_num_iterations = 3000
    trainer._announce_time()
    assert "about 2.5 hours for 3,000 iterations" in said[-1]
    assert torch.equal(torch.get_rng_state(), random) and model.training
    torch.testing.assert_close(dict(model.state_dict()), before, rtol=0, atol=0, equal_nan=True)


def test_a_gpus_plan_counts_what_the_run_itself_takes_and_gave_back(monkeypatch):
    """So a run that prepares targets may have as many Gaussians as the next one, and a resumed run too."""
    held = {"free": 2e9, "cached": 5e9}
    monkeypatch.setattr(
        torch.cuda, "empty_cache", lambda: held.update(free=held["free"] + held.pop("cached", 0))
    )
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (held["free"], 16e9))
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 1e9)
    planned = sizes.memory_to_plan_with(torch.device("cuda"))
    assert planned == pytest.approx(sizes.SHARE * 8e9 - sizes.CONTEXT)


def test_on_a_gpu_the_plan_is_within_half_of_what_an_h200_took():
    """A million Gaussians in one color, photos of 1000 × 700: a step held .54 GB, learning words 1.15 GB."""

    def run(words: bool):
        numbers = {"means": 3, "scales": 3, "quats": 4, "features_dc": 3, "features_rest": 0, "opacities": 1}
        million = {name: torch.empty(1_000_000, size, device="meta") for name, size in numbers.items()}
        return SimpleNamespace(
            gaussians=million,
            parts=Parts(),
            device=torch.device("cuda"),
            learns_words_at_the_end=words,
            learns_from_renderings=False,
        )

    for words, measured in ((False, 0.54e9), (True, 1.15e9)):
        fixed, each = sizes.bytes_of(run(words), 700_000)
        assert measured <= fixed + 1e6 * each <= 1.5 * measured
