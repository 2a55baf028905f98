"""The demo command: its report, repeated runs, interruption."""

import json
import signal
from dataclasses import replace
from functools import partial

import pytest
import torch

from lab.landmark import scene_writer
from lab.landmark.demo import Demo
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.training.checkpoint import CHECKPOINT
from lang3dxl_ns.training.fit import Run

pytestmark = pytest.mark.slow

SCENE = {"photos": 8, "test_views": 3, "quick": True, "wild": False}


@pytest.fixture(scope="module", autouse=True)
def few_steps_of_words():
    """Learning codes from photos takes 15 seconds otherwise, whatever the number of iterations."""
    settings = Demo.settings

    def fewer(self, out):
        found = settings(self, out)
        found.scene.decoder.compression.steps = 40
        found.scene.semantic_field = SemanticFieldConfig(code_dim=3)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Demo, "settings", fewer)
        yield


@pytest.fixture(scope="module")
def demo(tiny_clip, tiny_dense, tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    settings = Demo(out=out, clip=str(tiny_clip), dense=str(tiny_dense), steps=6, **SCENE)
    with pytest.MonkeyPatch.context() as patch:
        small = partial(scene_writer.DemoScene, width=240, height=180)
        patch.setattr(scene_writer, "DemoScene", small)
        settings.main()
    return settings


def test_the_report_holds_precision_quality_time_and_memory(demo):
    run = demo.out
    report = json.loads((run / "report.json").read_text())
    assert [split["protocol"]["photos"] for split in report["splits"].values()] == [3, 1]
    for split in report["splits"].values():
        for who in ("", "teacher_", "limit_", "chance_"):
            values = [v for name, v in split.items() if name.startswith(f"{who}ap_") and "photos" not in name]
            assert all(0 <= value <= 1 for value in values)
            assert split[f"{who}map"] == pytest.approx(sum(values) / len(values))
        assert split["limit_map"] > 2 * split["chance_map"]
        assert split["psnr"] > 5
    assert (
        set(report["seconds"]) == set(report["peak_mb"]) == {"scene", "prepare", "train", "words", "evaluate"}
    )
    assert report["splits"]["Test views"]["clip_l1"] > 0
    assert "2-D teacher" in (run / "report.md").read_text()
    assert (run / "report.png").stat().st_size > 10_000


def test_the_same_command_does_nothing_twice_and_another_length_is_another_run(demo):
    files = [demo.out / CHECKPOINT, demo.out / "scene.scene", demo.out / "scene" / "images" / "0001.jpg"]
    written = [path.stat().st_mtime_ns for path in files]
    demo.main()
    assert [path.stat().st_mtime_ns for path in files] == written
    with pytest.raises(UserError, match=r"another run \(steps 6\): give its options"):
        replace(demo, steps=8).main()


def test_another_scene_in_the_same_folder_is_refused(demo):
    with pytest.raises(UserError, match="seed 2, not 3: give --out"):
        Demo(out=demo.out, seed=3, **SCENE).main()


def test_flags_of_training_reach_it_and_a_scene_that_exists_is_not_made_again(demo, tmp_path, monkeypatch):
    monkeypatch.setattr("lab.landmark.scene_writer.write_scene", lambda _: pytest.fail("another scene"))
    (tmp_path / "scene").symlink_to(demo.out / "scene")
    settings = Demo(out=tmp_path, steps=2, clip="none", dense="none", train="--sky-gaussians 70", **SCENE)
    settings.main()
    before = json.loads((tmp_path / "report.json").read_text())
    for split in before["splits"].values():
        assert {"psnr", "cc_psnr", "ssim"} <= set(split)
        assert not {"map", "half_psnr", "clip_l1"} & set(split)
    replace(settings, train="--sky-gaussians 0", restart=True).main()
    assert json.loads((tmp_path / "report.json").read_text())["gaussians"] == before["gaussians"] - 70


def test_ctrl_c_while_training_keeps_the_run(demo, tmp_path, monkeypatch):
    (tmp_path / "scene").symlink_to(demo.out / "scene")
    original = Run.iterate

    def interrupted(self, step):
        if step == 3:
            signal.raise_signal(signal.SIGINT)
        original(self, step)

    monkeypatch.setattr(Run, "iterate", interrupted)
    settings = Demo(out=tmp_path, steps=6, clip=demo.clip, dense=demo.dense, **SCENE)
    with pytest.raises(SystemExit, match="same command continues"):
        settings.main()
    assert torch.load(tmp_path / CHECKPOINT, weights_only=True)["step"] == 3
    monkeypatch.undo()
    settings.main()
    assert torch.load(tmp_path / CHECKPOINT, weights_only=True)["words"]
