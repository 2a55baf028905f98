"""SIGTERM in a comparison: none of its runs goes on, and no partial files are left."""

import os
import signal
import subprocess
import sys
import time

from lab.landmark.scene_writer import DemoScene, write_scene


def test_a_stopped_comparison_ends_its_runs(tmp_path):
    sizes = {"photos": 8, "test_views": 0, "width": 128, "height": 96, "workers": 1}
    scene = write_scene(DemoScene(out=tmp_path / "scene", seed=5, **sizes))
    words = [sys.executable, "-m", "lang3dxl_ns.cli", "benchmark", "ablation", "--scene", str(scene)]
    words += ["--out", str(tmp_path), "--rows", "full", "hash", "--workers", "2"]
    words += ["--dense", "none"]
    # Started truly: all that belongs to it is a process group of its own.
    command = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    )
    try:
        wait_for(lambda: len(list(tmp_path.glob("work-*/runs/*/lang3dxl/*"))) == 2)
        command.send_signal(signal.SIGTERM)  # to the command alone, which passes it on to its runs
        said, _ = command.communicate(timeout=60)
        assert command.returncode == 130 and b"Stopped; finished work is kept." in said, said
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
