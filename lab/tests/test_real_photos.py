"""The benchmark on real photos: which runs it makes, and its report."""

from pathlib import Path

import pytest

from lab.benchmarks.ablation_rows import FULL, ROWS
from lab.benchmarks.real_photos import RealPhotos, tables
from lab.benchmarks.scored_runs import Run, ScoredRuns
from lang3dxl_ns.common.errors import UserError

FULL_ROW = next(row for row in ROWS if row.name == FULL)
WORDS = {
    "psnr": 20.5,
    "ssim": 0.6125,
    "seen_ap_windows_photos": 3,
    "seen_ap_windows": 0.7,
    "seen_map": 0.7,
    "seen_teacher_ap_windows": 0.4,
    "seen_teacher_map": 0.4,
    "seen_chance_ap_windows": 0.05,
    "seen_limit_ap_windows": 0.95,
    "ap_doors": 0.33,
    "ap_doors_photos": 1,
}


@pytest.fixture
def made(monkeypatch):
    """Names of the runs that would be made; they take no time."""
    names = []

    def make(self, run):
        names.append(run.name)
        return WORDS if (run.scene / "ground_truth").is_dir() else {"psnr": 18.0}

    monkeypatch.setattr(ScoredRuns, "finished", lambda self, run: None)
    monkeypatch.setattr(ScoredRuns, "make", make)
    return names


def scenes(tmp_path):
    (tmp_path / "castle" / "ground_truth").mkdir(parents=True)
    (tmp_path / "square").mkdir()
    return tmp_path / "castle", tmp_path / "square"


def test_every_scene_is_trained_and_those_with_truth_score_words(tmp_path, made):
    RealPhotos(scene=scenes(tmp_path), out=tmp_path / "out").main()
    assert sorted(made) == ["castle/full/1000-0", "square/full/1000-0"]
    report = (tmp_path / "out" / "real_photos.md").read_text()
    assert "python -m lab.benchmarks.real_photos" in report
    assert "20.50" in report
    assert report.count("## Words in photos that training saw of castle") == 1
    assert report.count("## Words in held-out photos of castle") == 1
    assert "of square" not in report


def test_baselines_run_where_words_are_scored(tmp_path, made):
    RealPhotos(scene=scenes(tmp_path), out=tmp_path / "out", baselines=("paper", "lifting")).main()
    assert [name for name in made if name.startswith("square")] == ["square/full/1000-0"]
    rows = {name.split("/")[1] for name in made if name.startswith("castle")}
    assert rows == {FULL, "paper", "lifting"}


def test_words_of_field_teacher_and_bounds_stand_in_their_own_rows():
    seen, held_out = "\n".join(tables({Run(FULL_ROW, Path("castle"), "castle", 0): WORDS})).split("## Words")[
        1:
    ]
    rows = [line.strip("| ").split(" | ") for line in seen.splitlines() if line.startswith("|")]
    assert rows[0] == ["windows", "mean"]
    assert [row[:2] for row in rows[2:]] == [
        ["lang3dxl, the default", "0.70"],
        ["2-D teacher", "0.40"],
        ["limit of the geometry", "0.95"],
        ["chance", "0.05"],
        ["photos", "3"],
    ]
    assert "0.33" in held_out and "0.70" not in held_out


def test_missing_and_doubled_scenes_are_told(tmp_path, made):
    castle, _ = scenes(tmp_path)
    for given, message in (
        ((), "give --scene"),
        ((tmp_path / "x",), "not a folder"),
        ((castle, castle), "two scenes"),
    ):
        with pytest.raises(UserError, match=message):
            RealPhotos(scene=given, out=tmp_path / "out").main()
