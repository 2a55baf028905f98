"""Preparation in several processes: shared work, and at most one photo lost by a killed process."""

import os
import shutil
import signal
import time
from pathlib import Path

import pytest
import torch
from processes import Process
from tiny_models import make_tiny_clip
from worker_tasks import prepare, write_photo

from lang3dxl_ns.preparation import kinds as preparation
from lang3dxl_ns.preparation.store import FeatureStore


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return str(make_tiny_clip(tmp_path_factory.mktemp("models") / "clip", dim=16, image_size=16))


def prepare_and_note(folder: Path, clip: str) -> None:
    """Prepares a folder's photos, and notes in a file of this process which it makes targets of."""
    build = preparation.build_clip_target

    def noted(*arguments):
        with (folder / f"made-{os.getpid()}").open("a") as file:
            file.write(".")
        return build(*arguments)

    preparation.build_clip_target = noted
    prepare(folder, clip, 1, "local")


@pytest.mark.slow
def test_two_commands_on_one_folder_do_no_harm_and_one_that_is_killed_loses_nothing(tmp_path, clip):
    names = [write_photo(tmp_path, f"{i:03d}.png", i) for i in range(40)]
    first, second = (Process(prepare_and_note, tmp_path, clip) for _ in range(2))
    targets = tmp_path / "store" / "clip"
    while not (targets.is_dir() and len(list(targets.glob("*.safetensors"))) >= 4):
        assert second.poll() is None
        time.sleep(0.02)
    first.send_signal(signal.SIGKILL)
    done = second.wait()
    assert done.returncode == 0, done.stderr
    first.wait()
    store = FeatureStore(tmp_path / "store")
    assert all(store.read("clip", name) for name in names)
    made = [len(path.read_text()) for path in tmp_path.glob("made-*")]
    assert 40 <= sum(made) <= 80  # both may make a photo; the last complete write counts


@pytest.mark.slow
def test_several_workers_make_what_one_makes(tmp_path, clip, forked_workers):
    for i in range(6):
        write_photo(tmp_path, f"{i}.png", i)
    one = prepare(tmp_path, clip, 1, "local")
    shutil.rmtree(tmp_path / "store")
    several = prepare(tmp_path, clip, 2, "local")
    torch.testing.assert_close(one, several)
