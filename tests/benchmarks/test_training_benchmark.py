"""The training benchmark writes the parts of a step."""

import json
from concurrent.futures import ThreadPoolExecutor

from scenes import write_scene

from lang3dxl_ns.benchmarks import training


def test_the_report_has_every_part_of_a_step_and_they_fill_it(tmp_path, tiny_clip, tiny_dense, monkeypatch):
    monkeypatch.setattr(training, "ProcessPoolExecutor", lambda *_, **__: ThreadPoolExecutor(1))
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    models = str(tiny_clip), str(tiny_dense)
    training.TrainingBenchmark(data, tmp_path / "out", *models, iterations=3, scale=1.0).main()
    found = json.loads((tmp_path / "out/training.json").read_text())
    for run in found.values():
        # Appearance is within the rendering; a few steps' mean may exceed their median.
        parts = sum(seconds for part, seconds in run["split_seconds"].items() if part != "appearance")
        assert 0 < parts < 3 * run["seconds_per_step"]
    assert "| backward (ms) |" in (tmp_path / "out/training.md").read_text()
