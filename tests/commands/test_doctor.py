"""`lang3dxl doctor`: its checks and their remedies."""

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


def test_a_gpu_that_torch_does_not_see_is_a_problem(monkeypatch):
    from lang3dxl_ns.common import device

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(device, "_reason", lambda: "The NVIDIA driver on your system is too old")
    monkeypatch.setattr("shutil.which", lambda name, **_: "/usr/bin/" + name)
    (found,) = doctor.devices()
    assert found.verdict == "problem"
    assert "driver" in found.remedy and "too old" in found.remedy
    monkeypatch.setattr("shutil.which", lambda name, **_: None)
    (found,) = doctor.devices()
    assert found.verdict == "note"


@pytest.mark.parametrize(("missing", "words"), [((), "built first"), (("ninja",), "slowly")])
def test_the_verdict_says_what_the_gpu_would_render_with(monkeypatch, missing, words, tmp_path):
    from fake_gpu import fake_gpu

    from lang3dxl_ns.rendering import gsplat_build

    monkeypatch.setattr(doctor, "_has_gpu", lambda: True)
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    needs = [gsplat_build.Need(n, None if n in missing else "there", f"get {n}") for n in ("nvcc", "ninja")]
    monkeypatch.setattr(gsplat_build, "needs", lambda _: needs)
    with fake_gpu():
        found = list(doctor.devices())
        assert words in doctor.verdict(found)
        folder = gsplat_build.build_folder("8.9")
        folder.mkdir()
        for name in ("done", "gsplat_cuda.so"):
            (folder / name).touch()
        assert doctor.verdict(list(doctor.devices())) == "ready; the GPU renders with gsplat"
    assert [finding.remedy for finding in found if finding.remedy] == [f"get {name}" for name in missing]


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
