"""Ctrl-C and SIGTERM in the middle of a command: nothing is left by halves, and it can be given again."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from label_sets import write_plain

from lang3dxl_ns import cli
from lang3dxl_ns.demo.scene_writer import DemoScene, write_scene
from lang3dxl_ns.preparation.store import FeatureStore

STOPPED = """
import importlib, os, sys
from lang3dxl_ns import cli
place, name, number = sys.argv[1:4]
owner = importlib.import_module(place)
work, calls = getattr(owner, name), []
def stopped(*arguments, **options):
    calls.append(1)
    if len(calls) == 3:
        os.kill(os.getpid(), int(number))
    return work(*arguments, **options)
setattr(owner, name, stopped)
cli.main(sys.argv[4:])
"""
"""A command that gets a signal when it calls some function for the third time."""


def stop(place: str, function: str, number: signal.Signals, arguments: list[str]) -> None:
    words = [sys.executable, "-c", STOPPED, place, function, str(int(number)), *arguments]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert done.returncode == 130, done.stderr
    assert "Stopped; what was finished is kept." in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_preparation_keeps_its_photos_and_goes_on(scene, tiny_clip, tmp_path, capsys, number):
    arguments = ["prepare", "--data", str(scene), "--cache-dir", str(tmp_path), "--clip", str(tiny_clip)]
    arguments += ["--dense", "none"]
    stop("lang3dxl_ns.preparation.prepare", "build_clip_target", number, arguments)
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.safetensors")}
    assert len(kept) == 2
    cli.main(arguments)
    assert "Targets of 12 photos" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert [path.suffix for path in tmp_path.rglob("clip/*")] == [".safetensors"] * 12
    store = FeatureStore(tmp_path)
    assert all(store.read("clip", path.name) for path in (scene / "images").iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_evaluation_leaves_the_report_that_was_there(tmp_path, number):
    rng = np.random.default_rng(0)
    (tmp_path / "maps" / "dome").mkdir(parents=True)
    for photo in range(6):
        mask = np.zeros((24, 32), bool)
        mask[:, :16] = True
        write_plain(tmp_path / "truth", "dome", f"{photo}", mask)
        np.save(tmp_path / "maps" / "dome" / f"{photo}.npy", rng.random((24, 32)))
    arguments = ["evaluate", "maps", "--maps", str(tmp_path / "maps")]
    arguments += ["--ground-truth", str(tmp_path / "truth"), "--out"]
    stop("lang3dxl_ns.evaluation.predictions", "_read_array", number, [*arguments, str(tmp_path / "out")])
    assert not list(tmp_path.glob("out/*"))
    cli.main([*arguments, str(tmp_path / "out")])
    before = (tmp_path / "out" / "scores.json").read_bytes()
    stop("lang3dxl_ns.evaluation.predictions", "_read_array", number, [*arguments, str(tmp_path / "out")])
    assert (tmp_path / "out" / "scores.json").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_comparison_ends_its_runs(tmp_path, number):
    scene = write_scene(DemoScene(out=tmp_path / "scene", seed=5, photos=10, width=128))
    words = [sys.executable, "-m", "lang3dxl_ns.cli", "benchmark", "ablation", "--scene", str(scene)]
    words += ["--out", str(tmp_path), "--rows", "full", "hash", "--dense-tokens", "8", "--workers", "2"]
    command = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    )
    try:
        wait_for(lambda: len(list(tmp_path.glob("work-*/runs/**/events.*"))) == 2)
        command.send_signal(number)  # to it alone: its runs hear of it from the command
        said, _ = command.communicate(timeout=60)
        assert command.returncode == 130 and b"Stopped; what was finished is kept." in said, said
        wait_for(lambda: not group_lives(command.pid))
    finally:
        if group_lives(command.pid):
            os.killpg(command.pid, signal.SIGKILL)
    assert not list(tmp_path.glob("work-*")) and not list(tmp_path.glob("results/**/*.json"))


def wait_for(condition, seconds: float = 200) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.2)


def group_lives(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
