"""`lang3dxl train`: settings by short names, and what it leaves and says."""

import pytest
import torch
from scenes import write_scene

import lang3dxl_ns
from lang3dxl_ns import cli
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.training import fit as fitting


def test_short_names_reach_the_settings_and_the_folder_opens(tmp_path, capsys):
    data, out = write_scene(tmp_path / "scene", photos=4, points=60), tmp_path / "run"
    words = ["train", str(data), "--out", str(out), "--steps", "3", "--clip", "none"]
    cli.main([*words, "--sky-gaussians", "50", "--view-dependence", "off", "--looks", "off"])
    assert "lang3dxl view" in capsys.readouterr().out
    scene = lang3dxl_ns.load_scene(out)
    assert scene.splats.degree == 0
    means = torch.load(out / "training.ckpt", weights_only=True)["tensors"]["gauss_params.means"]
    assert len(means) == len(scene.splats)
    cli.main([*words, "--sky-gaussians", "70", "--view-dependence", "off", "--looks", "off", "--restart"])
    assert len(lang3dxl_ns.load_scene(out).splats) == len(means) + 20


def test_the_papers_method_keeps_its_settings_where_none_are_given(monkeypatch, tmp_path):
    made = []
    monkeypatch.setattr(
        fitting, "run_folder", lambda data, out, settings, *_: made.append(settings) or (out, None)
    )
    cli.main(["train", str(tmp_path), "--out", "x", "--method", "lang3dxl-paper", "--dense-weight", "3.0"])
    (settings,) = made
    assert settings.scene.decoder.name == "paper" and settings.scene.dense_weight == 3.0
    assert settings.photo_scale == 0.5 and settings.targets.regions == "sam"


def test_a_wrong_setting_is_named_as_it_is_spelled_here(tmp_path):
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    with pytest.raises(SystemExit, match=r"Error: --ssim-lambda is 2"):
        cli.main(["train", str(data), "--ssim-lambda", "2", "--clip", "none"])
    with pytest.raises(UserError, match="there is no setting clipp"):
        lang3dxl_ns.train(data, tmp_path / "run", clipp="none")


def test_ctrl_c_from_python_is_the_error_that_it_promises(tmp_path, monkeypatch):
    data = write_scene(tmp_path / "scene", photos=4, points=60)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(fitting, "fit", interrupted)
    with pytest.raises(UserError, match="training was stopped; to resume"):
        lang3dxl_ns.train(data, tmp_path / "run", steps=6, clip="none")
