"""`lang3dxl train`: settings by short names, and what it leaves and says."""

from pathlib import Path

import pytest
import torch
from scenes import write_scene

import lang3dxl_ns
from lang3dxl_ns import cli
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.open_scene import existing_scene_file
from lang3dxl_ns.preparation.needs import read_needs
from lang3dxl_ns.training import fit as fitting
from lang3dxl_ns.training.fit import Settings
from lang3dxl_ns.web.photos import folder_of_run


def test_short_names_reach_the_settings_and_the_folder_opens(tmp_path, capsys, monkeypatch):
    """Unnamed, as the newest run here, and with its photos and measured needs."""
    monkeypatch.chdir(tmp_path)
    data, out = write_scene(tmp_path / "scene", photos=4, points=60), tmp_path / "outputs" / "scene"
    words = ["train", str(data), "--steps", "3", "--clip", "none"]
    cli.main([*words, "--sky-gaussians", "50", "--view-dependence", "off", "--looks", "off"])
    said = " ".join(capsys.readouterr().out.split())
    assert "lang3dxl view" in said and "1 of 4 photos are held out of training" in said
    assert "(--eval-mode all trains on all" in said
    assert folder_of_run(existing_scene_file()) == data and read_needs(out)["view dependence"] in (
        True,
        False,
    )
    scene = lang3dxl_ns.load_scene()
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


def parsed(*words) -> Settings:
    return cli._parsed(["train", "photos", *words]).settings()


@pytest.mark.parametrize("words", [["--method"], ["--method", "--steps", "5"]])
def test_a_method_without_its_name_is_told(words, capsys):
    with pytest.raises(SystemExit):
        parsed(*words)
    assert "--method" in capsys.readouterr().err


@pytest.mark.parametrize("method", ["lang3dxl", "lang3dxl-paper"])
def test_the_command_alone_has_a_methods_usual_settings(method):
    found, usual = parsed("--method", method), Settings.of(method)
    for part in ("scene", "targets", "capture", "photo_scale", "seed", "steps", "save_every"):
        assert getattr(found, part) == getattr(usual, part)


def test_what_is_given_counts_even_where_it_is_usual_for_another_method():
    words = ["--codes-from", "noise", "--regions", "auto", "--view-dependence", "auto", "--looks", "auto"]
    words += ["--densify-until", "0.5", "--photo-scale", "1", "--scale-mode", "auto"]
    for method in (["--method", "lang3dxl-paper"], ["--method=lang3dxl-paper"]):
        found = parsed(*words, *method)
        assert found.scene.decoder.name == "paper"
        assert (found.scene.codes_from, found.targets.regions, found.targets.scale_mode) == (
            *("noise", "auto", "auto"),
        )
        assert (found.scene.view_dependence, found.scene.appearance.use) == ("auto", "auto")
        assert (found.scene.densify_until, found.photo_scale) == (0.5, 1.0)


def test_photos_are_found_and_held_out_as_the_options_say(tmp_path):
    data = write_scene(tmp_path / "scene", photos=6, points=60)
    (data / "images").rename(data / "pictures")
    (tmp_path / "list.txt").write_text("photo_001.jpg")
    words = ["--images-path", "pictures", "--held-out", str(tmp_path / "list.txt"), "--clip", "none"]
    cli.main(["train", str(data), "--out", str(tmp_path / "run"), "--steps", "2", *words])
    scene = lang3dxl_ns.load_scene(tmp_path / "run")
    assert [photo.name for photo in scene.photos if photo.split == "eval"] == ["photo_001.jpg"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--ssim-lambda", "2"], "--ssim-lambda is 2"),
        (["--steps", "0"], "--steps is 0: give a number from 1"),
        (["--photo-scale", "0"], "--photo-scale is 0"),
        (["--save-every", "0"], "--save-every is 0"),
        (["--scale-factor", "nan"], "--scale-factor is nan"),
        (["--eval-interval", "1"], "--eval-interval is 1: give a number from 2"),
        (["--clip-weight", "7"], "--clip-weight has no effect .* --method lang3dxl-paper"),
        (["--regions", "felzenszwalb"], "--regions has no effect"),
    ],
)
def test_a_wrong_setting_is_named_as_it_is_spelled_here(tmp_path, words, message):
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    with pytest.raises(SystemExit, match=f"Error: {message}"):
        cli.main(["train", str(data), "--out", str(tmp_path / "run"), "--clip", "none", *words])
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"clipp": "none"}, "there is no setting clipp: did you mean clip?"),
        ({"check": 1}, "there is no setting check"),
        ({"scene": 5}, "scene can't be 5"),
        ({"photo_scale": "half"}, "photo_scale can't be 'half'"),
        ({"looks": "perhaps"}, "looks can't be 'perhaps'"),
        ({"method": "paper"}, "there is no method 'paper': choose one of lang3dxl, lang3dxl-paper"),
        ({"warm_up": 0.3}, "--warm-up has no effect"),
    ],
)
def test_a_wrong_setting_from_python_is_named(tmp_path, setting, message):
    with pytest.raises(UserError, match=message.replace("?", r"\?")):
        lang3dxl_ns.train(tmp_path, tmp_path / "run", **setting)


def test_settings_from_python_reach_the_run(monkeypatch, tmp_path):
    made = []
    monkeypatch.setattr(
        fitting, "run_folder", lambda data, out, settings, restart: (made.append(settings), 1)
    )
    lang3dxl_ns.train("photos", clip="builtin", looks="off", held_out="list.txt", photo_scale=1, seed=7)
    (found,) = made
    assert (found.targets.clip, found.scene.appearance.use) == ("builtin", "off")
    assert (found.capture.held_out, found.photo_scale, found.seed) == (Path("list.txt"), 1, 7)


def test_ctrl_c_from_python_is_the_error_that_it_promises(tmp_path, monkeypatch):
    data = write_scene(tmp_path / "scene", photos=4, points=60)

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(fitting, "fit", interrupted)
    for restart, but in ((False, ""), (True, ", without restart if iterations had begun")):
        with pytest.raises(UserError, match=f"training was stopped; to resume: the same call{but}$"):
            lang3dxl_ns.train(data, tmp_path / "run", steps=6, clip="none", restart=restart)
