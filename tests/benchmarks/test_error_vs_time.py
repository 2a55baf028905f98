"""The sweep of error against run time: its knobs, its Pareto front, its report."""

import json
from copy import deepcopy
from pathlib import Path

import pytest

from lang3dxl_ns.benchmarks.error_vs_time import DEFAULT, ErrorVsTime, mark_front, stage_points
from lang3dxl_ns.benchmarks.scored_runs import Run, apply_changes


def test_every_knob_is_a_setting_of_a_run_and_has_a_name_of_its_own():
    from lang3dxl_ns.methods import lang3dxl

    settings = ErrorVsTime((Path("s"),), Path("o"))
    rows, default = settings.rows(), deepcopy(lang3dxl.config)
    data = default.pipeline.datamanager
    data.camera_res_scale_factor, data.dense_tokens = settings.scale, settings.dense_tokens
    assert len({row.name for row in rows}) == len(rows)
    assert {row.group for row in rows[1:]} == {"prepare", "train", "query"}
    for row in rows[1:]:
        if row.name == "targets":  # the default's
            continue
        config = deepcopy(default)
        apply_changes(config, row.changes)
        assert config != default, row.name
    assert len(ErrorVsTime((Path("s"),), Path("o"), quick=True).rows()) < len(rows)


def points(*values: tuple[float, float]) -> list[dict]:
    return [{"seconds": {"mean": s}, "map": {"mean": m}, "clip_l1": {"mean": 1 - m}} for s, m in values]


def test_on_the_front_is_what_nothing_else_beats_in_time_and_quality():
    found = points((1, 0.2), (2, 0.5), (3, 0.4), (4, 0.5), (5, 0.9))
    mark_front(found)
    assert [bool(point["front"]) for point in found] == [True, True, False, False, True]
    assert found[0]["front"] == ["map", "clip_l1"]  # more is better of one, less of the other


def test_a_row_counts_in_the_stages_that_it_measures():
    sweep = ErrorVsTime((Path("s"),), Path("o"))
    rows = sweep.rows()
    tokens = next(row for row in rows if row.name == "dense-tokens-24")
    measured = {"map": 0.5, "clip_l1": 0.3, "psnr": 20.0, "setup_seconds": 9.0, "train_seconds": 60.0}
    figures = {
        Run(row, Path("s"), "s", seed): measured | {"render_ms": 20.0, "answer_ms": 80.0 + 40 * seed}
        for row in (DEFAULT, tokens)
        for seed in range(2)
    }
    found = stage_points(rows, figures)
    assert {(p["row"], p["stage"]) for p in found} == {
        (tokens.name, "prepare"),
        *((row.name, stage) for row in (DEFAULT, tokens) for stage in ("train", "query")),
    }
    query = next(point for point in found if point["stage"] == "query")
    assert query["seconds"]["mean"] == pytest.approx(0.12)


def test_the_report_is_written_whatever_is_there(tmp_path):
    sweep = ErrorVsTime((Path("s"),), tmp_path)
    sweep._write({}, {})
    assert not (tmp_path / "error_vs_time.png").exists()
    figures = {Run(DEFAULT, Path("s"), "s", 0): {"map": 0.5, "train_seconds": 60.0}}
    failed = {Run(sweep.rows()[1], Path("s"), "s", 0): "no memory"}
    sweep._write(figures, failed)
    text = (tmp_path / "error_vs_time.md").read_text()
    assert "| Lang3D-XL | 60 | **0.500** | – | – | – |" in text and "no memory" in text
    assert json.loads((tmp_path / "error_vs_time.json").read_text())["points"][0]["front"] == ["map"]
    assert (tmp_path / "error_vs_time.png").exists()
