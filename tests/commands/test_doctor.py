"""`lang3dxl doctor`: its checks and their remedies."""

import sys

import pytest
import torch

from lang3dxl_ns.cli import main
from lang3dxl_ns.commands import doctor


def test_every_problem_comes_with_a_remedy_and_without_secrets(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LANG3DXL_CHAT_KEY", "sesame-open")
    monkeypatch.setenv("HF_TOKEN", "sesame-open")
    found = list(doctor.findings(tmp_path))
    whats = " ".join(finding.what for finding in found)
    for topic in ("Python", "torch", "gsplat", "device", "memory", "disk, data", "openai/clip", "ffmpeg"):
        assert topic in whats
    assert all(finding.remedy for finding in found if finding.verdict != "ok")
    monkeypatch.setattr(doctor, "findings", lambda *_: iter(found))
    main(["doctor"])
    printed = capsys.readouterr().out
    assert "nerfstudio" in printed
    assert "sesame" not in printed


@pytest.mark.parametrize(
    ("probe", "verdict", "words"),
    [
        ("pass", "ok", "work"),
        ("raise RuntimeError('no kernel image')", "problem", "no kernel image"),
        ("import time; time.sleep(60)", "note", "not built within"),
    ],
)
def test_gsplat_is_tried_in_a_process_of_its_own_with_a_time_limit(probe, verdict, words):
    found = doctor.gsplat_build(probe, seconds=20 if verdict != "note" else 0.5)
    assert (found.verdict, words in found.found) == (verdict, True)
    assert (verdict == "ok") == (found.remedy == "")


def test_a_gpu_that_torch_does_not_see_is_a_problem(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: "/usr/bin/" + name)
    (found,) = doctor.devices(1)
    assert found.verdict == "problem"
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    (found,) = doctor.devices(1)
    assert found.verdict == "note"


def test_versions_are_checked_against_the_requirements(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "version", lambda name: "1.0" if name == "gsplat" else "9999.1")
    monkeypatch.setattr(doctor, "_requirements", lambda: {"gsplat": "==1.4.0", "torch": ">=2.6"})
    found = {finding.what: finding for finding in doctor.versions()}
    assert found["torch"].verdict == "ok"
    assert found["gsplat"].verdict == "problem"
    assert "gsplat==1.4.0" in found["gsplat"].remedy
    monkeypatch.setattr(doctor, "findings", lambda *_: iter([found["gsplat"]]))
    with pytest.raises(SystemExit, match="1 problem"):
        main(["doctor"])


def test_weights_say_where_they_are_or_would_come_from(monkeypatch):
    import huggingface_hub

    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", lambda name, file: f"/cache/{name}/{file}")
    assert all(f.verdict == "ok" and "/cache/" in f.found for f in doctor.weights())
    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", lambda name, file: None)
    for finding in doctor.weights():
        assert "huggingface.co" in finding.found
        assert "hf download" in finding.remedy


def test_the_probe_is_python():
    compile(doctor._PROBE, "probe", "exec")
    assert sys.executable
