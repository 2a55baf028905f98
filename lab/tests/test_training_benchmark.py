"""The report of the training benchmark has the parts of a step."""

import json
from concurrent.futures import ThreadPoolExecutor

from scenes import write_scene
from tiny_models import make_tiny_clip, make_tiny_dinov2

from lab.benchmarks import training
from lab.run_config import run_config


def test_the_report_of_training_has_the_parts_of_a_step(tmp_path, monkeypatch):
    def quick(*arguments):
        config = run_config(*arguments)
        config.pipeline.model.decoder.compression.steps = 40  # 15 seconds otherwise
        return config

    monkeypatch.setattr("lab.run_config.run_config", quick)
    monkeypatch.setattr(training, "ProcessPoolExecutor", lambda *_, **__: ThreadPoolExecutor(1))
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    models = str(make_tiny_clip(tmp_path / "clip")), str(make_tiny_dinov2(tmp_path / "dinov2"))
    training.TrainingBenchmark(data, tmp_path / "out", *models, iterations=3, scale=1.0).main()
    found = json.loads((tmp_path / "out/training.json").read_text())
    assert {"render", "backward", "optimizer"} <= set(found["rgb only"]["split_seconds"])
    assert all(seconds > 0 for run in found.values() for seconds in run["split_seconds"].values())
    assert "| backward (ms) |" in (tmp_path / "out/training.md").read_text()
