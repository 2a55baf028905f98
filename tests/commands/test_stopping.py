"""Ctrl-C and SIGTERM in a command: no partial files, and the command can be repeated."""

import importlib
import os
import signal

import numpy as np
import pytest
from label_sets import write_plain
from processes import Process

from lang3dxl_ns import cli
from lang3dxl_ns.preparation.store import FeatureStore

READING = ("lang3dxl_ns.evaluation.predictions", "_read_array")


def stopped(place: str, function: str, number: int, arguments: list[str]) -> None:
    """A command that receives a signal at the third call of some function."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start background jobs without it
    owner = importlib.import_module(place)
    work, calls = getattr(owner, function), []

    def signaled(*arguments, **options):
        calls.append(1)
        if len(calls) == 3:
            os.kill(os.getpid(), number)
        return work(*arguments, **options)

    setattr(owner, function, signaled)
    cli.main(arguments)


def stop(place: str, function: str, number: signal.Signals, arguments: list[str]) -> None:
    done = Process(stopped, place, function, int(number), arguments).wait()
    assert done.returncode == 130, done.stderr
    assert "Stopped; finished work is kept." in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.nerfstudio
def test_a_stopped_preparation_keeps_its_photos_and_goes_on(scene, tiny_clip, tmp_path, capsys, number):
    arguments = ["prepare", "--data", str(scene), "--cache-dir", str(tmp_path), "--clip", str(tiny_clip)]
    arguments += ["--dense", "none", "--crops", "pyramid"]
    stop("lang3dxl_ns.preparation.kinds", "build_clip_target", number, arguments)
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.safetensors")}
    assert len(kept) == 2
    cli.main(arguments)
    assert "Targets of 12 photos" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert [path.suffix for path in tmp_path.rglob("clip/*")] == [".safetensors"] * 12
    store = FeatureStore(tmp_path)
    assert all(store.read("clip", path.name) for path in (scene / "images").iterdir())


def test_a_stopped_evaluation_leaves_the_report_that_was_there(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "maps" / "dome").mkdir(parents=True)
    for photo in range(6):
        mask = np.zeros((24, 32), bool)
        mask[:, :16] = True
        write_plain(tmp_path / "truth", "dome", f"{photo}", mask)
        np.save(tmp_path / "maps" / "dome" / f"{photo}.npy", rng.random((24, 32)))
    arguments = ["evaluate", "maps", "--maps", str(tmp_path / "maps")]
    arguments += ["--ground-truth", str(tmp_path / "truth"), "--out"]
    stop(
        "lang3dxl_ns.evaluation.predictions",
        "_read_array",
        signal.SIGINT,
        [*arguments, str(tmp_path / "out")],
    )
    assert not list(tmp_path.glob("out/*"))
    cli.main([*arguments, str(tmp_path / "out")])
    before = (tmp_path / "out" / "scores.json").read_bytes()
    stop(
        "lang3dxl_ns.evaluation.predictions",
        "_read_array",
        signal.SIGINT,
        [*arguments, str(tmp_path / "out")],
    )
    assert (tmp_path / "out" / "scores.json").read_bytes() == before
