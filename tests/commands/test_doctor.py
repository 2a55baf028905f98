"""`lang3dxl doctor`: its checks and their remedies."""

import sys

import pytest
import torch

from lang3dxl_ns import UserError, cli, load_scene
from lang3dxl_ns.cli import main
from lang3dxl_ns.commands import doctor


def test_every_problem_comes_with_a_remedy_and_without_secrets(monkeypatch, capsys):
    monkeypatch.setenv("LANG3DXL_CHAT_KEY", "sesame-open")
    monkeypatch.setenv("HF_TOKEN", "sesame-open")
    monkeypatch.setattr("shutil.which", lambda name, **_: None)
    found = list(doctor.findings())
    whats = " ".join(finding.what for finding in found)
    for topic in ("Python", "torch", "gsplat", "pycolmap", "device", "memory", "disk", "ffmpeg"):
        assert topic in whats
    assert all(finding.remedy for finding in found if finding.verdict != "ok")
    monkeypatch.setattr(doctor, "findings", lambda: iter(found))
    main(["doctor"])
    printed = capsys.readouterr().out
    assert "nerfstudio" in printed and "ready" in printed
    assert "sesame" not in printed
    assert "apt install colmap" not in printed  # the library pycolmap reconstructs, not the program


def test_a_gpu_that_torch_does_not_see_is_a_problem(monkeypatch):
    from lang3dxl_ns.common import device

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(device, "_reason", lambda: "The NVIDIA driver on your system is too old")
    monkeypatch.setattr("shutil.which", lambda name, **_: "/usr/bin/" + name)
    (found,) = doctor.devices()
    assert found.verdict == "problem"
    assert "driver" in found.remedy and "too old" in found.remedy


def test_what_gsplat_needs_is_named(monkeypatch, tmp_path):
    from fake_gpu import fake_gpu

    from lang3dxl_ns.rendering import gsplat_build

    monkeypatch.setattr("shutil.which", lambda name, **_: "/usr/bin/" + name)
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    needs = [gsplat_build.Need("nvcc", "there", "get nvcc"), gsplat_build.Need("ninja", None, "get ninja")]
    monkeypatch.setattr(gsplat_build, "needs", lambda _: needs)
    with fake_gpu():
        found = list(doctor.devices())
    assert [finding.remedy for finding in found if not finding.fine] == ["get ninja"]
    assert found[0].what == "device cuda:0"


def test_versions_are_checked_against_the_requirements(monkeypatch):
    monkeypatch.setattr(doctor, "version", lambda name: "1.0" if name == "gsplat" else "9999.1")
    monkeypatch.setattr(
        doctor, "requires", lambda _: ["gsplat==1.4.0", "torch>=2.6", "ray; extra == 'ray'", "torch<9999"]
    )
    found = {finding.what: finding for finding in doctor.versions()}
    assert set(found) == {"Python", "nerfstudio", "gsplat", "torch"} and len([*doctor.versions()]) == 4
    assert found["torch"].verdict == "problem" and "<9999" in found["torch"].remedy
    assert found["gsplat"].verdict == "problem"
    assert "gsplat==1.4.0" in found["gsplat"].remedy
    monkeypatch.setattr(doctor, "findings", lambda: iter([found["gsplat"]]))
    with pytest.raises(SystemExit, match="1 problem"):
        main(["doctor"])


@pytest.mark.parametrize(("python", "says"), [((3, 13, 1), "3.10 to 3.12"), ((3, 11, 2), "pip install")])
def test_the_half_that_is_not_installed_is_a_note_with_its_reason(monkeypatch, python, says):
    monkeypatch.setattr(doctor, "find_spec", lambda _: None)
    monkeypatch.setattr(doctor.sys, "version_info", python)
    need = "nerfstudio==1.1.5; python_version < '3.13' and extra == 'nerfstudio'"
    monkeypatch.setattr(doctor, "requires", lambda _: [need])
    _, half = doctor.versions()  # Python itself, and nothing of the half that is missing
    assert half.verdict == "note" and says in half.remedy


def test_a_command_that_needs_nerfstudio_says_how_to_install_it(monkeypatch, tmp_path):
    def main(self):
        raise ModuleNotFoundError("No module named 'nerfstudio'", name="nerfstudio.cameras")

    monkeypatch.setattr(doctor.Doctor, "main", main)
    with pytest.raises(SystemExit, match=r"\.\[nerfstudio\]"):
        cli.main(["doctor"])
    monkeypatch.setitem(sys.modules, "nerfstudio", None)
    monkeypatch.setitem(sys.modules, "nerfstudio.data.scene_box", None)
    for name in ("lang3dxl_ns.plugin.load_scene", "lang3dxl_ns.plugin.model"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "config.yml").write_text("x")
    with pytest.raises(UserError, match=r"\.\[nerfstudio\]"):
        load_scene(tmp_path)
