"""Preparation in several processes at once: the work is shared, and a death loses one photo's at most."""

import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_models import make_tiny_clip

from lang3dxl_ns.preparation.store import FeatureStore


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return str(make_tiny_clip(tmp_path_factory.mktemp("models") / "clip", dim=16, image_size=16))


def write_photo(folder, name, seed) -> str:
    (folder / "images").mkdir(exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (80, 100, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(folder / "images" / name)
    return name


PREPARE = """
import os
import sys
from lang3dxl_ns.preparation import prepare as module
from lang3dxl_ns.preparation.photo import Photo
from pathlib import Path
from lang3dxl_ns.preparation.store import FeatureStore
folder, clip = Path(sys.argv[1]), sys.argv[2]
paths = sorted((folder / "images").glob("*.png"))
photos = [Photo(p.name, p, None, 100, 80, 90.0, 90.0, 50.0, 40.0) for p in paths]
build = module.build_clip_target
def noted(*arguments):
    with (folder / f"made-{os.getpid()}").open("a") as file:
        file.write(".")
    return build(*arguments)
module.build_clip_target = noted
config = module.PreparationConfig(clip=clip, dense="none", workers=int(sys.argv[3]), engine=sys.argv[4])
targets = module.prepare(photos, None, config, [0.4, 0.8], FeatureStore(folder / "store"), "cpu")
print("names", len(targets.reader.names))
"""


@pytest.mark.slow
def test_two_commands_on_one_folder_share_the_work_and_one_that_is_killed_loses_nothing(tmp_path, clip):
    names = [write_photo(tmp_path, f"{i:03d}.png", i) for i in range(40)]
    words = [sys.executable, "-c", PREPARE, str(tmp_path), clip, "1", "local"]
    first, second = (subprocess.Popen(words, stdout=subprocess.PIPE, text=True) for _ in range(2))
    targets = tmp_path / "store" / "clip"
    while not (targets.is_dir() and len(list(targets.glob("*.safetensors"))) >= 4):
        assert second.poll() is None
        time.sleep(0.02)
    first.send_signal(signal.SIGKILL)
    assert "names 40" in second.communicate(timeout=300)[0]
    first.wait()
    store = FeatureStore(tmp_path / "store")
    assert all(store.read("clip", name) for name in names)
    made = [len(path.read_text()) for path in tmp_path.glob("made-*")]
    assert 40 <= sum(made) <= 41  # the photo that the first was at may have been made twice, no other


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["local", "ray"])
def test_several_workers_make_what_one_makes(tmp_path, clip, engine):
    if engine == "ray":
        pytest.importorskip("ray")
    for i in range(6):
        write_photo(tmp_path, f"{i}.png", i)
    found = {}
    for workers, how in (("1", "local"), ("2", engine)):
        words = [sys.executable, "-c", PREPARE, str(tmp_path), clip, workers, how]
        done = subprocess.run(words, capture_output=True, text=True, timeout=500)
        assert "names 6" in done.stdout, done.stdout + done.stderr
        store = FeatureStore(tmp_path / "store")
        found[workers] = [store.read("clip", f"{i}.png")["features"].clone() for i in range(6)]
        shutil.rmtree(tmp_path / "store")
    for one, several in zip(found["1"], found["2"], strict=True):
        torch.testing.assert_close(one, several)
