"""The benchmark on real photos: which runs it makes, and its report."""

from pathlib import Path

import pytest

from lang3dxl_ns.baselines.rows import FULL, ROWS
from lang3dxl_ns.benchmarks.real_photos import RealPhotos, tables
from lang3dxl_ns.benchmarks.scored_runs import Run, ScoredRuns
from lang3dxl_ns.common.errors import UserError

FULL_ROW = next(row for row in ROWS if row.name == FULL)
WORDS = {
    "psnr": 20.5,
    "seen_ap_windows": 0.7,
    "seen_map": 0.7,
    "seen_teacher_ap_windows": 0.4,
    "seen_teacher_map": 0.4,
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
    assert "lang3dxl benchmark real-photos" in report
    assert "20.50" in report
    assert report.count("## Words in the masked photos") == 1
    assert "2-D teacher" in report


def test_baselines_run_where_words_are_scored(tmp_path, made):
    RealPhotos(scene=scenes(tmp_path), out=tmp_path / "out", baselines=True).main()
    assert [name for name in made if name.startswith("square")] == ["square/full/1000-0"]
    assert len([name for name in made if name.startswith("castle")]) >= 4


def test_the_words_of_field_and_teacher_are_not_mixed_up():
    text = "\n".join(tables({Run(FULL_ROW, Path("castle"), "castle", 0): WORDS}))
    field = next(line for line in text.splitlines() if line.startswith("| Lang3D-XL") and "0.70" in line)
    teacher = next(line for line in text.splitlines() if line.startswith("| 2-D teacher"))
    assert "0.40" in teacher
    assert "0.40" not in field


def test_missing_and_doubled_scenes_are_told(tmp_path, made):
    castle, _ = scenes(tmp_path)
    for given, message in (
        ((), "give --scene"),
        ((tmp_path / "x",), "not a folder"),
        ((castle, castle), "two scenes"),
    ):
        with pytest.raises(UserError, match=message):
            RealPhotos(scene=given, out=tmp_path / "out").main()
