"""The benchmark of queries: every figure is there, and each timed text is a new one."""

from pathlib import Path

import pytest
from painted_scene import painted_scene

from lang3dxl_ns.benchmarks.queries import QueryBenchmark, _markdown


def test_new_texts_and_frames_are_timed(monkeypatch):
    scene, encoded = painted_scene(), []
    prompts = scene.prompts
    monkeypatch.setattr(scene, "prompts", lambda text: encoded.append(text) or prompts(text))
    benchmark = QueryBenchmark(run=Path("config.yml"), out=Path("out"), size=(64, 48), repeats=2)
    figures = benchmark.measure(scene)
    assert (figures["width"], figures["height"]) == (64, 48)
    assert all(figures[name] > 0 for name in ("text_ms", "frame_0_ms", "frame_1_ms", "frame_4_ms"))
    assert figures["ratio_4"] == pytest.approx(figures["frame_4_ms"] / figures["frame_0_ms"])
    assert len(set(encoded)) == len(encoded) == 23  # 20 texts, a first one and two frames
    assert "with four prompts" in _markdown(figures, "command", "machine")
