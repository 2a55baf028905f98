"""Full and read-only disks, names that are files or too long, and servers that never answer."""

import errno
import os
import shutil
import socket
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lang3dxl_ns.cli import main
from lang3dxl_ns.common import files, parallel
from lang3dxl_ns.common.console import gigabytes
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.open_scene import load_scene
from lang3dxl_ns.plugin.trainer import _disk_kept_out_of_training, writer
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore


@pytest.fixture
def run(two_steps, tmp_path):
    return shutil.copytree(two_steps.base_dir, tmp_path / "run")


def refuse(number):
    def fail(*_args, **_options):
        raise OSError(number, os.strerror(number))

    return fail


# ── checkpoints ─────────────────────────────────────────────────────────────────────────────────────────


def full_after(count, error):
    """torch.save to a disk with room for so many bytes."""

    def save(_state, path, *_):
        Path(path).write_bytes(bytes(count))
        raise error

    return save


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left"), RuntimeError("PytorchStreamWriter failed writing file")]
)
def test_a_full_disk_leaves_no_half_checkpoint_and_training_goes_on(two_steps, monkeypatch, error, capsys):
    before = sorted(two_steps.checkpoint_dir.iterdir())
    monkeypatch.setattr(torch, "save", full_after(100, error))
    monkeypatch.setattr(two_steps, "_is_ending", False)
    two_steps.save_checkpoint(500)
    assert sorted(two_steps.checkpoint_dir.iterdir()) == before
    assert not list(two_steps.base_dir.rglob("*.partial"))
    assert "Training continues" in " ".join(capsys.readouterr().out.split())
    monkeypatch.setattr(two_steps, "_is_ending", True)
    with pytest.raises(UserError, match=r"step-000000500\.ckpt can't be written .* GB are free"):
        two_steps.save_checkpoint(500)
    assert not list(two_steps.base_dir.rglob("*.partial"))


def test_a_log_that_can_not_be_written_does_not_end_training(train, scene, monkeypatch, capsys):
    """tensorboard's thread keeps the error of a full disk, and raises it in the next step."""
    monkeypatch.setattr(writer, "EVENT_WRITERS", [])
    monkeypatch.setattr(writer.TensorboardWriter, "write_scalar", refuse(errno.ENOSPC))
    trainer = train(scene, iterations=3, semantics=False)
    assert trainer.step == 2 and list(trainer.checkpoint_dir.glob("*.ckpt"))
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("The log can't be written") == 1 and "lang3dxl view" in said


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_the_logs_own_thread_does_not_print_the_error_again(monkeypatch, capsys):
    monkeypatch.setattr(threading, "excepthook", threading.__excepthook__)
    with _disk_kept_out_of_training():
        for raised in (refuse(errno.ENOSPC), lambda: 1 / 0):
            thread = threading.Thread(target=raised)
            thread.start()
            thread.join()
    said = capsys.readouterr().err
    assert "No space left" not in said and "ZeroDivisionError" in said
    assert threading.excepthook is threading.__excepthook__


def test_a_run_that_could_not_begin_leaves_no_folder(train, tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(UserError):
        train(tmp_path / "photos", semantics=False, output_dir=tmp_path / "outputs")
    assert not list((tmp_path / "outputs").rglob("*"))


# ── asking and exporting ────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("number", [errno.EROFS, errno.ENOSPC, errno.EACCES])
def test_a_run_that_can_not_be_written_to_answers(run, monkeypatch, number):
    monkeypatch.setattr(files.os, "replace", refuse(number))
    scene = load_scene(run / "config.yml")
    assert np.isfinite(scene.query("dome", "photo_000").relevancy).all()
    assert scene.find("dome").relevancy.any()
    assert not list(run.glob("*.tmp"))


@pytest.mark.parametrize("number", [errno.EROFS, errno.ENOSPC])
@pytest.mark.parametrize("command", ["query", "export"])
def test_a_full_or_read_only_disk_is_one_line_and_leaves_no_half_file(
    run, tmp_path, monkeypatch, number, command
):
    out = tmp_path / "out" / ("found" if command == "query" else "found.ply")
    monkeypatch.setattr(files.os, "fsync", refuse(number))
    options = ["--threshold", "0"] + (["--image", "photo_000"] if command == "query" else [])
    with pytest.raises(SystemExit, match=r"Error: .*found.*" + os.strerror(number)):
        main([command, str(run / "config.yml"), "--text", "a", "--out", str(out), *options])
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


@pytest.mark.parametrize("command", ["query", "export"])
@pytest.mark.parametrize("out", ["file/below", "file/far/below", "n" * 300, "/proc/none/found"])
def test_places_that_can_not_be_written_to_are_told_before_the_work(tmp_path, command, out):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SystemExit, match=r"Error: .*(not a file|shorter|does not exist|another place)"):
        main([command, "none.yml", "--text", "a", "--out", str(tmp_path / out / "x")])
    assert (tmp_path / "file").read_text() == "mine"


def test_a_file_is_no_folder_and_a_folder_no_file(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SystemExit, match=r"Error: .*file: File exists; name a folder"):
        main(["query", "none.yml", "--text", "a", "--out", str(tmp_path / "file")])
    with pytest.raises(SystemExit, match=r"Error: .* is a folder: name"):
        main(["export", "none.yml", "--text", "a", "--out", str(tmp_path)])


@pytest.mark.parametrize("place", ["/dev/null", "/dev/null/below", "/proc/none", "n" * 300])
def test_a_store_that_can_be_none_is_one_line(place):
    with pytest.raises(UserError, match="cache-dir DIR"):
        FeatureStore(Path(place)).make_folder()


def test_sizes_are_told_in_a_unit_that_shows_them():
    assert [gigabytes(x) for x in (1_500, 2_500_000, 3 * 10**9)] == ["1.50 kB", "2.50 MB", "3.00 GB"]


# ── a cluster that never answers ────────────────────────────────────────────────────────────────────────


def test_an_attempt_to_connect_that_never_ends_is_left_after_its_time(monkeypatch):
    forever, closed = threading.Event(), []
    there = PreparationConfig(engine="ray", address="there")

    def ray(init):
        return SimpleNamespace(init=init, shutdown=lambda: closed.append(init))

    parallel._connect(ray(lambda **_: None), there)
    with pytest.raises(UserError, match=r"answers at there \('x'\): give --address"):
        parallel._connect(ray(lambda **_: {}["x"]), there)
    assert len(closed) == 1
    monkeypatch.setattr(parallel, "PATIENCE_S", 0.01)
    with pytest.raises(UserError, match="no answer within 0 s"):
        parallel._connect(ray(lambda **_: forever.wait()), there)
    forever.set()
    assert len(closed) == 1


def test_a_cluster_that_never_answers_is_one_line(monkeypatch, capsys):
    """A port that takes connections and says nothing."""
    ray = pytest.importorskip("ray")
    asked = []
    monkeypatch.setattr(parallel, "PATIENCE_S", 0.05)
    monkeypatch.setattr(ray, "init", lambda **options: (asked.append(options), threading.Event().wait(30)))
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(UserError, match=f"no Ray cluster answers at {address}"):
            list(parallel.run(PreparationConfig(engine="ray", address=address), None, [1], "cpu"))
    assert [options["address"] for options in asked] == [address]
    assert f"connecting to the Ray cluster at {address}" in " ".join(capsys.readouterr().out.split())
