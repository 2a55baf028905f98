"""The training benchmark writes the parts of a step."""

import json
from concurrent.futures import ThreadPoolExecutor

from scenes import write_scene

from lang3dxl_ns.benchmarks import training


def test_the_report_has_the_parts_of_a_step(tmp_path, tiny_clip, tiny_dense, monkeypatch):
    monkeypatch.setattr(training, "ProcessPoolExecutor", lambda *_, **__: ThreadPoolExecutor(1))
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    models = str(tiny_clip), str(tiny_dense)
    training.TrainingBenchmark(data, tmp_path / "out", *models, iterations=3, scale=1.0).main()
    found = json.loads((tmp_path / "out/training.json").read_text())
    assert {"render", "backward", "optimizer"} <= set(found["rgb only"]["split_seconds"])
    assert all(seconds > 0 for run in found.values() for seconds in run["split_seconds"].values())
    assert "| backward (ms) |" in (tmp_path / "out/training.md").read_text()
