"""The ablation benchmark: its rows, their changes, finished runs, the report."""

import csv
import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny_models import make_tiny_grounding_dino, make_tiny_sam

from lab.benchmarks.ablation import Ablation, bound_figures, make_all
from lab.benchmarks.ablation_report import mark_front, spread, table_of_runs, write_ablation
from lab.benchmarks.ablation_rows import (
    CHANCE,
    CLIPSEG,
    FINE_TEACHER,
    FULL,
    LANGSAM,
    LIMIT,
    ROWS,
    SYSTEMS,
    TEACHER,
    Row,
    choose_rows,
)
from lab.benchmarks.scored_runs import (
    Run,
    RunSettings,
    ScoredRuns,
    _beside,
    apply_changes,
    run_configuration,
    scene_labels,
)
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.presets import train_flags

BY_NAME = {row.name: row for row in ROWS}


def settings(scale: float = 1.0) -> RunSettings:
    return RunSettings(
        "builtin", "builtin", "none", scale, "--pipeline.datamanager.dense-tokens 8", "nothing"
    )


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
    made = list[str]()
    runs = runs_of(FULL, "fmgs")
    first, _ = make_all(runs, Counting(tmp_path, made), lambda *_: None)
    assert made == ["here/full/1200-0", "here/fmgs/1200-0"]
    again, _ = make_all(runs + runs_of("direct"), Counting(tmp_path, made), lambda *_: None)
    assert made[2:] == ["here/direct/1200-0"]
    assert {run: again[run] for run in first} == first
    make_all(runs, Counting(tmp_path, made, scale=0.5), lambda *_: None)
    assert made[3:] == ["here/full/1200-0", "here/fmgs/1200-0"]


def test_a_run_that_fails_says_why_and_is_tried_again_and_others_go_on(tmp_path):
    made = list[str]()
    runs = runs_of(CLIPSEG, FULL)
    figures, failed = make_all(runs, Counting(tmp_path, made, fails=(CLIPSEG,)), lambda *_: None)
    assert [run.row.name for run in figures] == [FULL]
    assert list(failed.values()) == ["no weights"]
    figures, failed = make_all(runs, Counting(tmp_path, made), lambda *_: None)
    assert not failed and len(figures) == 2
    assert made == ["here/clipseg/1200-0", "here/full/1200-0", "here/clipseg/1200-0"]


def test_a_stopped_run_gives_no_result(tmp_path, monkeypatch):
    made = list[str]()
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


def test_a_stopped_comparison_has_every_row_on_every_scene_once_before_any_twice(tmp_path):
    scenes = {name: tmp_path / name for name in ("a", "b")}
    rows = [BY_NAME[name] for name in (FULL, "fmgs", CLIPSEG, TEACHER)]
    runs = Ablation(tmp_path, seeds=2, steps=(6, 4)).runs(scenes, rows)
    assert [run.seed for run in runs] == [0] * 10 + [1] * 8  # segmenters once, bounds never
    made = list[str]()
    make_all(runs[:3], Counting(tmp_path, made), lambda *_: None)
    make_all(runs, Counting(tmp_path, made), lambda *_: None)
    assert sorted(made) == sorted(run.name for run in runs)


def test_clipsegs_folder_decides_about_its_own_row_alone(tmp_path):
    made = list[str]()
    runs = runs_of(FULL, CLIPSEG, LANGSAM)
    for folder in ("here", "there"):
        store = Counting(tmp_path, made)
        store.settings = replace(store.settings, clipseg=folder)
        make_all(runs, store, lambda *_: None)
    assert made == [f"here/{name}/1200-0" for name in (FULL, CLIPSEG, LANGSAM, CLIPSEG)]


def test_a_figure_that_is_not_finite_gives_no_result(tmp_path, monkeypatch):
    store = Counting(tmp_path, [])
    monkeypatch.setattr(store, "_submit", lambda run, log: {"map": float("nan"), "psnr": 20.0})
    (run,) = runs_of(FULL)
    _, failed = make_all([run], store, lambda *_: None)
    assert "not finite: map" in failed[run]


@pytest.mark.nerfstudio
def test_rows_change_one_setting_each_of_those_that_a_run_has():
    from lang3dxl_ns.methods import lang3dxl

    for row in ROWS:
        config = deepcopy(lang3dxl.config)
        apply_changes(config, row.changes)
        assert (config == lang3dxl.config) is (not row.changes), row.name
        assert config.pipeline.model.semantic_field.resolved()
    with pytest.raises(AttributeError):
        apply_changes(deepcopy(lang3dxl.config), {"pipeline.model.no_such_setting": 1})


@pytest.mark.nerfstudio
def test_flags_of_all_rows_are_read_as_ns_train_reads_them(tmp_path):
    """Switches take True or False, as `lang3dxl preset official` prints them."""
    flags = replace(settings(), flags=" ".join(train_flags("official")))
    run = Run(BY_NAME["lang3dxl-paper"], tmp_path, "here", 0)
    config = run_configuration(run, flags, tmp_path / "work")
    assert config.pipeline.model.appearance.opacity_shift is False
    assert config.pipeline.model.semantic_field.preset == "official"


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
        Run(BY_NAME[FULL], Path(scene), scene, seed): {
            "map": next(values),
            "teacher_map": 0.6,
            "train_seconds": 9.0,
        }
        for seed in range(2)
        for scene in ("there", "here")
    }


def test_the_report_gives_deviations_over_seeds_of_means_over_scenes(tmp_path):
    figures = figures_of_two_scenes()
    rows = [BY_NAME[name] for name in (FULL, TEACHER, CLIPSEG)]
    failed = {Run(BY_NAME[CLIPSEG], Path("here"), "here", 0): "no weights"}
    figures = figures | bound_figures(rows, figures)
    write_ablation(tmp_path, "the command", rows, figures, failed)
    full, teacher, clipseg = json.loads((tmp_path / "ablation.json").read_text())["lengths"]["1200"]
    assert full["mean"]["map"]["mean"] == pytest.approx(0.3)
    assert full["mean"]["map"]["std"] == pytest.approx(abs(0.15 - 0.45) / 2**0.5)
    assert full["scenes"]["there"]["map"]["mean"] == pytest.approx(0.3)
    assert teacher["mean"]["map"]["mean"] == pytest.approx(0.6)
    assert clipseg["not_run"] == ["no weights"] and not clipseg["mean"]
    text = (tmp_path / "ablation.md").read_text()
    assert "0.300 ± 0.212" in text and "not run here" in text
    lines = list(csv.DictReader((tmp_path / "ablation.csv").open()))
    assert {(line["row"], line["scene"], line["seed"]) for line in lines} >= {("full", "there", "1")}
    assert len(lines) == len(figures)


@pytest.mark.nerfstudio
def test_a_seed_that_lacks_a_scene_is_left_out_of_the_mean_over_scenes(tmp_path):
    figures = figures_of_two_scenes()
    figures.popitem()
    write_ablation(tmp_path, "", [BY_NAME[FULL]], figures, {})
    (full,) = json.loads((tmp_path / "ablation.json").read_text())["lengths"]["1200"]
    assert full["mean"]["map"] == {"mean": pytest.approx(0.15), "std": 0.0, "runs": 1}


def test_scenes_of_one_family_have_a_mean_and_the_deviation_between_them(tmp_path):
    scores = {"hall-1": 0.2, "hall-2": 0.4, "mosque-1": 0.5}
    figures = {Run(BY_NAME[FULL], Path(s), s, 0): {"map": value} for s, value in scores.items()}
    write_ablation(tmp_path, "", [BY_NAME[FULL]], figures, {})
    text = (tmp_path / "ablation.md").read_text()
    assert "| mAP by family | hall | mosque |" in text and "| 0.300 ± 0.141 | 0.500 |" in text


def test_a_line_of_the_table_is_a_run():
    text = table_of_runs({Run(Row("a", "g", "l"), Path("s"), "s", 3): {"map": 0.25, "psnr": 9.0}})
    assert text == "row,group,scene,steps,seed,map,psnr\na,g,s,1200,3,0.25,9.0\n"


def test_bounds_are_rows_of_figures_that_the_full_method_brings_along():
    figures = {run: {"test_limit_map": 0.9, "limit_map": 0.8, "map": 0.5} for run in runs_of(FULL, "direct")}
    (found,) = bound_figures([BY_NAME[LIMIT], BY_NAME["direct"]], figures).items()
    assert found[0].row.name == LIMIT and found[1] == {"test_map": 0.9, "map": 0.8}


def test_the_front_holds_rows_unbeaten_in_time_and_quality():
    values = [(1, 0.2), (2, 0.5), (3, 0.4), (4, 0.5), (5, 0.9), (None, 0.95)]
    rows = [{"mean": {"map": {"mean": m}} | ({"train_seconds": {"mean": s}} if s else {})} for s, m in values]
    mark_front(rows, "map")
    assert [row["front"] for row in rows] == [True, True, False, False, True, False]


def test_new_weights_of_the_same_name_make_runs_anew(tmp_path, monkeypatch):
    made = list[str]()
    make_all(runs_of(FULL), Counting(tmp_path, made), lambda *_: None)
    monkeypatch.setattr(ScoredRuns, "_clip_weights", "others")
    make_all(runs_of(FULL), Counting(tmp_path, made), lambda *_: None)
    assert len(made) == 2


@pytest.mark.nightly
def test_the_command_trains_scores_and_reports(tmp_path, capsys):
    from lab.landmark.scene_writer import DemoScene, write_scene

    sizes = {"photos": 10, "test_views": 6, "width": 128, "height": 96, "workers": 1}
    scene = write_scene(DemoScene(out=tmp_path / "scene", seed=5, **sizes))
    out = tmp_path / "out"
    names = (FULL, TEACHER, FINE_TEACHER, LIMIT, CHANCE, CLIPSEG, LANGSAM, "lifting")
    detector = make_tiny_grounding_dino(tmp_path / "detector", seed=2)
    sam = make_tiny_sam(tmp_path / "sam", seed=2)
    few = "--pipeline.datamanager.dense-tokens 8"
    few += " --pipeline.model.decoder.compression.steps 40"  # learning codes takes 15 seconds otherwise
    short = {"steps": (4, 6), "ns_train": few}
    short |= {"clipseg": str(tmp_path / "no"), "langsam": (str(detector), str(sam))}
    command = Ablation(out, (scene,), rows=names, **short)
    command.main()
    lengths = json.loads((out / "ablation.json").read_text())["lengths"]
    assert list(lengths) == ["4", "6"]
    for rows in lengths.values():
        assert [bool(row["mean"]) for row in rows] == [row["row"] != CLIPSEG for row in rows]
        assert next(row for row in rows if row["row"] == CLIPSEG)["not_run"]
        means = {row["row"]: row["mean"] for row in rows if row["mean"]}
        assert 0 < means[LANGSAM]["test_map"]["mean"] < means[TEACHER]["test_map"]["mean"]
        assert means[FINE_TEACHER]["test_map"]["mean"] > means[LANGSAM]["test_map"]["mean"]
        del means[LANGSAM], means[FINE_TEACHER]  # scored where others are tested, not where they are trained
        for split in ("", "test_", "seen_"):
            scores = {name: values[f"{split}map"]["mean"] for name, values in means.items()}
            assert scores[CHANCE] < scores[TEACHER] and 2 * scores[CHANCE] < scores[LIMIT]
        assert means[FULL]["test_map"] != means[FULL]["seen_map"] != means[FULL]["map"]
    assert "test views" in (out / "ablation.md").read_text()
    assert not list(out.glob("work*"))
    assert [path.name for path in out.glob("results/scene/langsam/*.json")] == ["4-0.json"]  # once for both
    stamp = (out / "results/scene/full/4-0.json").stat().st_mtime_ns
    command.main()
    assert (out / "results/scene/full/4-0.json").stat().st_mtime_ns == stamp


@pytest.mark.nerfstudio
def test_labels_of_held_out_photos_alone_are_enough(tmp_path):
    capture = SimpleNamespace(folder=tmp_path, split=SimpleNamespace(train=("a.jpg", "b.jpg")))
    pipeline = SimpleNamespace(
        evaluation=SimpleNamespace(scorer=SimpleNamespace(truth=SimpleNamespace(key=lambda name: None))),
        datamanager=SimpleNamespace(data=SimpleNamespace(capture=capture)),
    )
    assert _beside(pipeline) == {}


def test_the_systems_are_rows():
    assert [row.name for row in choose_rows(("systems",), True, False)] == [
        row.name for row in ROWS if row.name in SYSTEMS
    ]
    assert set(SYSTEMS) <= set(BY_NAME)
