"""Whole runs with encoders of other families: targets, training, and answers by the same vocabulary."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fake_gpu import fake_gpu
from runs import train_run
from scenes import write_scene
from tiny_models import make_tiny_clip
from tiny_teachers import TEACHERS

from lang3dxl_ns.open_scene import load_scene

RUNS = {
    "clip, dense": (make_tiny_clip, "dense"),
    **{name: (make, "auto") for name, make in TEACHERS.items()},
    "siglip2, dense": (TEACHERS["siglip2"], "dense"),
}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("teachers") / "scene", photos=4, points=60, size=(40, 30))


def trained(name, small, folder, **changes):
    if name in ("siglip", "tipsv2"):
        pytest.importorskip("sentencepiece")
    make, features = RUNS[name]
    clip = make(folder / "encoder")
    changes = {
        "pipeline__datamanager__clip_features": features,
        "pipeline__datamanager__cache_dir": folder / "targets",
        "pipeline__datamanager__scales": 1,
        "steps_per_eval_image": 0,
        **changes,
    }
    return train_run(small, clip, "none", folder / "outputs", iterations=2, **changes)


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_run_with_any_family_prepares_trains_and_answers(name, small, tmp_path):
    trainer = trained(name, small, tmp_path)
    features = trainer.pipeline.model.clip_mean
    scene = load_scene(tmp_path / "outputs", device="cpu")
    match = scene.query("Rose Window", scene.photos[0].name)
    assert np.isfinite(match.relevancy).all() and match.relevancy.max() <= 1
    assert scene.engine.temperature > 0 and len(features) == scene.text.vectors(["a"]).shape[1]


def test_a_dense_run_works_on_a_fake_gpu(small, tmp_path):
    with fake_gpu():
        trainer = trained("clip, dense", small, tmp_path, machine__device_type="cuda")
        assert all(p.device.type == "cuda" for p in trainer.pipeline.model.parameters())
    assert not torch.cuda.is_available()
