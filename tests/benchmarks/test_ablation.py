"""The ablation: which rows there are, that they change what they say, and that finished runs are kept."""

import csv
import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from lang3dxl_ns.baselines.rows import CLIPSEG, FULL, ROWS, TEACHER, Row, choose_rows
from lang3dxl_ns.benchmarks.ablation import Ablation, make_all, teacher_figures
from lang3dxl_ns.benchmarks.ablation_report import spread, table_of_runs, write_ablation
from lang3dxl_ns.benchmarks.scored_runs import (
    Run,
    RunSettings,
    ScoredRuns,
    _seen_in_training,
    apply_changes,
    scene_labels,
)
from lang3dxl_ns.errors import UserError

BY_NAME = {row.name: row for row in ROWS}


def settings(steps: int = 3) -> RunSettings:
    return RunSettings(steps, "builtin", "builtin", "none", 1.0, 8, "", "nothing")


def runs_of(*names: str, seeds: int = 1, scene: str = "here") -> list[Run]:
    return [Run(BY_NAME[name], Path("/tmp") / scene, scene, seed) for seed in range(seeds) for name in names]


class Counting(ScoredRuns):
    """Runs that take no time; remembers which were made."""

    def __init__(self, folder: Path, made: list[str], fails: tuple[str, ...] = (), **changes):
        super().__init__(folder, settings(**changes))
        self.made, self.fails = made, fails

    def _submit(self, run: Run, log: Path) -> dict[str, float]:
        self.made.append(run.name)
        if run.row.name in self.fails:
            raise UserError("no weights")
        return {"map": 0.5 + 0.1 * run.seed, "ap_windows": 0.4, "teacher_map": 0.7, "train_seconds": 1.0}


def test_a_finished_run_is_not_made_again_and_one_with_other_settings_is(tmp_path):
    made: list[str] = []
    runs = runs_of(FULL, "fmgs")
    first, _ = make_all(runs, Counting(tmp_path, made), lambda *_: None)
    assert made == ["here/full/0", "here/fmgs/0"]
    again, _ = make_all(runs + runs_of("direct"), Counting(tmp_path, made), lambda *_: None)
    assert made[2:] == ["here/direct/0"]
    assert {run: again[run] for run in first} == first
    make_all(runs, Counting(tmp_path, made, steps=4), lambda *_: None)
    assert made[3:] == ["here/full/0", "here/fmgs/0"]


def test_a_run_that_fails_says_why_and_is_tried_again_and_others_go_on(tmp_path):
    made: list[str] = []
    runs = runs_of(CLIPSEG, FULL)
    figures, failed = make_all(runs, Counting(tmp_path, made, fails=(CLIPSEG,)), lambda *_: None)
    assert [run.row.name for run in figures] == [FULL]
    assert list(failed.values()) == ["no weights"]
    figures, failed = make_all(runs, Counting(tmp_path, made), lambda *_: None)
    assert not failed and len(figures) == 2
    assert made == ["here/clipseg/0", "here/full/0", "here/clipseg/0"]


def test_a_stopped_run_is_no_result(tmp_path, monkeypatch):
    made: list[str] = []
    store = Counting(tmp_path, made)

    def stop(run, log):
        raise KeyboardInterrupt

    monkeypatch.setattr(store, "_submit", stop)
    (run,) = runs_of(FULL)
    with pytest.raises(KeyboardInterrupt):
        make_all([run], store, lambda *_: None)
    assert store.finished(run) is None


def test_runs_at_a_time_give_what_one_after_the_other_gives(tmp_path):
    runs = runs_of(FULL, "fmgs", CLIPSEG, seeds=3)
    one, many = (
        make_all(runs, Counting(tmp_path / str(n), [], fails=(CLIPSEG,)), lambda *_: None, workers=n)
        for n in (1, 4)
    )
    assert one == many and len(one[0]) == 6


def test_no_runs_at_a_time_is_an_error(tmp_path):
    with pytest.raises(UserError, match="--workers is 0"):
        make_all(runs_of(FULL), Counting(tmp_path, []), lambda *_: None, workers=0)


def test_clipsegs_folder_decides_about_its_own_row_alone(tmp_path):
    made: list[str] = []
    runs = runs_of(FULL, CLIPSEG)
    for folder in ("here", "there"):
        store = Counting(tmp_path, made)
        store.settings = replace(store.settings, clipseg=folder)
        make_all(runs, store, lambda *_: None)
    assert made == ["here/full/0", "here/clipseg/0", "here/clipseg/0"]


def test_a_figure_that_is_not_finite_is_no_result(tmp_path, monkeypatch):
    store = Counting(tmp_path, [])
    monkeypatch.setattr(store, "_submit", lambda run, log: {"map": float("nan"), "psnr": 20.0})
    (run,) = runs_of(FULL)
    _, failed = make_all([run], store, lambda *_: None)
    assert "not finite: map" in failed[run]


def test_rows_change_one_setting_each_of_those_that_a_run_has():
    from lang3dxl_ns.methods import lang3dxl

    for row in ROWS:
        config = deepcopy(lang3dxl.config)
        apply_changes(config, row.changes)
        assert (config == lang3dxl.config) is (not row.changes), row.name
        assert config.pipeline.model.semantic_field.resolved()
    with pytest.raises(AttributeError):
        apply_changes(deepcopy(lang3dxl.config), {"pipeline.model.no_such_setting": 1})


def test_rows_that_are_the_full_method_are_left_out_unless_asked_for():
    short = {row.name for row in choose_rows((), short_run=True, has_regions=False)}
    long = {row.name for row in choose_rows((), short_run=False, has_regions=True)}
    assert short ^ long == {"hash", "both", "regions", "no-regions"}
    assert "hash" in short and "no-regions" in long
    assert [row.name for row in choose_rows(("both", FULL), True, False)] == [FULL, "both"]
    with pytest.raises(UserError, match="no row nerf"):
        choose_rows(("nerf",), True, False)


def test_scenes_of_one_name_are_told_apart_by_the_folder_above(tmp_path):
    for folder in ("a/scene", "b/scene", "c"):
        (tmp_path / folder / "ground_truth").mkdir(parents=True)
    labels = scene_labels([tmp_path / "a/scene", tmp_path / "b/scene", tmp_path / "c"])
    assert list(labels) == ["scene", "b-scene", "c"]
    with pytest.raises(UserError, match="twice"):
        scene_labels([tmp_path / "c", tmp_path / "c"])
    with pytest.raises(UserError, match="no ground_truth"):
        scene_labels([tmp_path])


def test_a_spread_is_the_mean_and_the_deviation_of_the_sample():
    assert spread([1.0, 3.0]) == {"mean": 2.0, "std": pytest.approx(2**0.5), "runs": 2}
    assert spread([1.0]) == {"mean": 1.0, "std": 0.0, "runs": 1}
    assert spread([]) is None


def figures_of_two_scenes() -> dict[Run, dict[str, float]]:
    values = iter((0.1, 0.2, 0.5, 0.4))  # seed 0: there, here; seed 1
    return {
        Run(BY_NAME[FULL], Path(scene), scene, seed): {"map": next(values), "teacher_map": 0.6}
        for seed in range(2)
        for scene in ("there", "here")
    }


def test_the_report_gives_deviations_over_seeds_of_means_over_scenes(tmp_path):
    figures = figures_of_two_scenes()
    rows = [BY_NAME[name] for name in (FULL, TEACHER, CLIPSEG)]
    failed = {Run(BY_NAME[CLIPSEG], Path("here"), "here", 0): "no weights"}
    figures = figures | teacher_figures(rows, figures)
    write_ablation(tmp_path, "the command", rows, ["there", "here"], figures, failed)
    full, teacher, clipseg = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert full["mean"]["map"]["mean"] == pytest.approx(0.3)
    assert full["mean"]["map"]["std"] == pytest.approx(abs(0.15 - 0.45) / 2**0.5)
    assert full["scenes"]["there"]["map"]["mean"] == pytest.approx(0.3)
    assert teacher["mean"]["map"]["mean"] == pytest.approx(0.6)
    assert clipseg["not_run"] == ["no weights"] and not clipseg["mean"]
    text = (tmp_path / "ablation.md").read_text()
    assert "0.300 ± 0.212" in text and "not run here" in text
    assert (tmp_path / "ablation.png").read_bytes().startswith(b"\x89PNG")
    lines = list(csv.DictReader((tmp_path / "ablation.csv").open()))
    assert {(line["row"], line["scene"], line["seed"]) for line in lines} >= {("full", "there", "1")}
    assert len(lines) == len(figures)


def test_a_seed_that_lacks_a_scene_has_no_say_in_the_mean_over_scenes(tmp_path):
    figures = figures_of_two_scenes()
    figures.popitem()
    write_ablation(tmp_path, "", [BY_NAME[FULL]], ["there", "here"], figures, {})
    (full,) = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert full["mean"]["map"] == {"mean": pytest.approx(0.15), "std": 0.0, "runs": 1}


def test_a_line_of_the_table_is_a_run():
    text = table_of_runs({Run(Row("a", "g", "l"), Path("s"), "s", 3): {"map": 0.25, "psnr": 9.0}})
    assert text == "row,group,scene,seed,map,psnr\na,g,s,3,0.25,9.0\n"


@pytest.mark.slow
def test_the_command_trains_scores_and_reports(tmp_path, capsys):
    from lang3dxl_ns.demo.scene_writer import DemoScene, write_scene

    scene = write_scene(DemoScene(out=tmp_path / "scene", seed=5, photos=10, width=128))
    out = tmp_path / "out"
    names = (FULL, TEACHER, CLIPSEG, "lifting")
    Ablation((scene,), out, seeds=1, steps=4, dense_tokens=8, rows=names, clipseg=str(tmp_path / "no")).main()
    rows = json.loads((out / "ablation.json").read_text())["rows"]
    assert [bool(row["mean"]) for row in rows] == [True, True, False, True]
    assert all(0 < row["mean"]["map"]["mean"] <= 1 for row in rows if row["mean"])
    assert rows[2]["not_run"]
    seen = [row["mean"]["seen_map"]["mean"] for row in rows if row["mean"]]
    assert all(0 < value <= 1 for value in seen)
    assert seen != [row["mean"]["map"]["mean"] for row in rows if row["mean"]]
    assert not list(out.glob("work*"))
    stamp = (out / "results/scene/full/seed0.json").stat().st_mtime_ns
    Ablation((scene,), out, seeds=1, steps=4, dense_tokens=8, rows=names, clipseg=str(tmp_path / "no")).main()
    assert (out / "results/scene/full/seed0.json").stat().st_mtime_ns == stamp


def test_labels_of_held_out_photos_alone_are_no_error():
    photos = [SimpleNamespace(name="a.jpg"), SimpleNamespace(name="b.jpg")]
    pipeline = SimpleNamespace(
        scorer=SimpleNamespace(truth=SimpleNamespace(key=lambda name: None)),
        datamanager=SimpleNamespace(train_dataset=SimpleNamespace(photos=photos)),
    )
    assert _seen_in_training(pipeline) == {}
