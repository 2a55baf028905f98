"""The demo command: its report, repeated runs, interruption."""

import json
import signal
from functools import partial

import pytest

from lab.landmark import scene_writer
from lab.landmark.demo import Demo
from lang3dxl_ns.common.errors import UserError

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio]


SCENE = {"photos": 8, "test_views": 3, "quick": True, "wild": False}
FEW = "--pipeline.model.decoder.compression.steps 40 --pipeline.model.semantic-field.code-dim 3"
"""Learning codes from photos takes 15 seconds otherwise, whatever the number of iterations."""


@pytest.fixture(scope="module")
def demo(tiny_clip, tiny_dense, tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    settings = Demo(out=out, clip=str(tiny_clip), dense=str(tiny_dense), steps=6, ns_train=FEW, **SCENE)
    with pytest.MonkeyPatch.context() as patch:
        small = partial(scene_writer.DemoScene, width=240, height=180)
        patch.setattr(scene_writer, "DemoScene", small)
        settings.main()
    return settings


@pytest.fixture
def run(demo):
    return demo.out / "run" / "lang3dxl" / "demo"


def test_the_report_holds_precision_quality_time_and_memory(run):
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


def test_the_same_command_does_nothing_twice_but_goes_on_when_asked_for_more(demo, run):
    checkpoint = run / "nerfstudio_models" / "step-000000005.ckpt"
    written = checkpoint.stat().st_mtime_ns
    photo = (demo.out / "scene" / "images" / "0001.jpg").stat().st_mtime_ns
    demo.main()
    assert checkpoint.stat().st_mtime_ns == written
    demo.steps = 8
    demo.main()
    assert (run / "nerfstudio_models" / "step-000000007.ckpt").exists()
    assert (demo.out / "scene" / "images" / "0001.jpg").stat().st_mtime_ns == photo


def test_another_scene_in_the_same_folder_is_refused(demo):
    with pytest.raises(UserError, match="seed 2, not 3: give --out"):
        Demo(out=demo.out, seed=3, **SCENE).main()


def test_flags_of_training_reach_it_and_a_scene_that_exists_is_not_made_again(demo, tmp_path, monkeypatch):
    monkeypatch.setattr("lab.landmark.scene_writer.write_scene", lambda _: pytest.fail("another scene"))
    (tmp_path / "scene").symlink_to(demo.out / "scene")
    settings = Demo(out=tmp_path, steps=2, clip="none", dense="none", **SCENE)
    settings.ns_train = "--pipeline.model.sky-gaussians 0"
    settings.main()
    report = json.loads((tmp_path / "run" / "lang3dxl" / "demo" / "report.json").read_text())
    for split in report["splits"].values():
        assert {"psnr", "cc_psnr", "ssim"} <= set(split)
        assert not {"map", "half_psnr", "clip_l1"} & set(split)


def test_ctrl_c_while_training_keeps_the_run(demo, tmp_path, monkeypatch):
    from lang3dxl_ns.plugin.model import Lang3DXLModel

    (tmp_path / "scene").symlink_to(demo.out / "scene")
    original = Lang3DXLModel.get_loss_dict

    def interrupted(self, *args):
        if self.step == 3:
            signal.raise_signal(signal.SIGINT)
        return original(self, *args)

    monkeypatch.setattr(Lang3DXLModel, "get_loss_dict", interrupted)
    settings = Demo(out=tmp_path, steps=6, clip=demo.clip, dense=demo.dense, ns_train=FEW, **SCENE)
    with pytest.raises(SystemExit, match="same command continues"):
        settings.main()
    checkpoints = tmp_path / "run" / "lang3dxl" / "demo" / "nerfstudio_models"
    assert [path.name for path in checkpoints.glob("*")] == ["step-000000003.ckpt"]
    monkeypatch.undo()
    settings.main()
    assert [path.name for path in checkpoints.glob("*")] == ["step-000000005.ckpt"]
