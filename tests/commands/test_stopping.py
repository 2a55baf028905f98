"""Ctrl-C and SIGTERM in a command: no partial files, and the command can be repeated."""

import atexit
import importlib
import os
import pty
import signal
import subprocess
import sys
import time
from typing import Any

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


class Finalized:
    """Object that receives a signal in its finalizer, where Python ignores exceptions."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        sum(range(100))


def stopped_in_a_finalizer(place: str, function: str, _: int, arguments: list[str]) -> None:
    """A command that receives a signal in a finalizer when it first calls some function."""
    owner, objects = importlib.import_module(place), [Finalized()]
    work = getattr(owner, function)

    def finalizing(*arguments, **options):
        objects.clear()
        time.sleep(0.5)
        return work(*arguments, **options)

    setattr(owner, function, finalizing)
    cli.main(arguments)


def stop(
    place: str, function: str, number: signal.Signals, arguments: list[str], stopped: Any = stopped
) -> None:
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
    place = ("lang3dxl_ns.evaluation.predictions", "_read_array")
    stop(*place, signal.SIGTERM, [*arguments, str(tmp_path / "out")], stopped_in_a_finalizer)
    assert (tmp_path / "out" / "scores.json").read_bytes() == before


SIGNALED = """
import atexit, os, signal, sys
signal.signal(signal.SIGINT, getattr(signal, sys.argv.pop(1)))  # shells start background jobs without it
number = int(sys.argv.pop(1))
atexit.register(lambda: (os.kill(os.getpid(), number), print("went on")))
from lang3dxl_ns.cli import main
sys.exit(main())
"""


def signaled(number: signal.Signals, handler: str, word: str) -> Any:
    """A command that receives a signal while Python runs the exit handlers."""
    script = [sys.executable, "-c", SIGNALED, handler, str(int(number)), word]
    return subprocess.run(script, capture_output=True, text=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("word", ["--help", "unknown"])
def test_a_signal_after_a_command_has_told_its_end_ends_it_without_a_word(number, word):
    ended = signaled(number, "default_int_handler", word)
    assert ended.returncode == -number  # shells tell 130, or 143
    assert ended.stdout.startswith("usage" if word == "--help" else "")
    assert ended.stderr.count("\n") == (word == "unknown") and "went on" not in ended.stdout


def test_a_signal_that_the_caller_ignores_stays_ignored_at_a_commands_end():
    ended = signaled(signal.SIGINT, "SIG_IGN", "--help")
    assert ended.returncode == 0 and "went on" in ended.stdout


HUNG_UP = """
import select, signal, sys
from pathlib import Path
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.stopping import stoppable
signal.signal(signal.SIGHUP, getattr(signal, sys.argv[1]))
asked, terminal = [], select.poll()
terminal.register(1, 0)
with stoppable(asked.append):
    print("ready", flush=True)
    for _ in range(6_000):
        if asked or terminal.poll(10):
            break
    say("Saving", "what was learned")
    print("to a file", file=sys.stderr, flush=True)
Path(sys.argv[2]).write_text(str(asked))
"""
"""Work that notes what asks it to stop until its terminal is gone, and saves then."""


@pytest.mark.parametrize(("handler", "asks"), [("SIG_DFL", "SIGHUP"), ("SIG_IGN", "[]")])
def test_a_lost_terminal_asks_training_to_save_unless_nohup_says_otherwise(tmp_path, handler, asks):
    child, terminal = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, "-c", HUNG_UP, handler, str(tmp_path / "saved")])
    told = b""
    while b"ready\r\n" not in told:  # to its end, or the line itself would fail
        told += os.read(terminal, 1000)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert asks in (tmp_path / "saved").read_text()


def end_of_nerfstudio() -> None:
    """What nerfstudio's commands do: import torch and what else has exit handlers, and then our methods."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    atexit.register(lambda: (os.kill(os.getpid(), signal.SIGINT), print("went on")))
    importlib.reload(importlib.import_module("lang3dxl_ns.methods"))


@pytest.mark.nerfstudio
def test_nerfstudios_commands_end_without_a_word_too():
    ended = Process(end_of_nerfstudio).wait()
    assert ended.returncode == -signal.SIGINT and not ended.stderr and "went on" not in ended.stdout
