"""Work for processes to share: squares that leave a trace, and small preparations.

from worker_tasks import Squares, prepare, write_photo
"""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image


@dataclass
class Squares:
    """Work that leaves a trace, and ends its process at one item, once."""

    folder: Path
    deadly: int = -1

    def start(self, device):
        def square(item):
            trap = self.folder / "sprung"
            if item == self.deadly and not trap.exists():
                trap.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            (self.folder / f"{item}.{os.getpid()}").touch()
            time.sleep(0.05)
            return item**2

        return square


def write_photo(folder: Path, name: str, seed: int) -> str:
    """A photo of noise, 100×80, in `folder`/images."""
    (folder / "images").mkdir(exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (80, 100, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(folder / "images" / name)
    return name


def prepare(folder: Path, clip: str, workers: int, engine: str) -> list:
    """Makes the targets of a folder's photos in `folder`/store; returns them."""
    # Here, so that a process that squares numbers starts without torch.
    from lang3dxl_ns.preparation import prepare as preparation
    from lang3dxl_ns.preparation.settings import PreparationConfig
    from lang3dxl_ns.preparation.store import FeatureStore
    from lang3dxl_ns.scene.camera import Lens
    from lang3dxl_ns.scene.photo import Photo

    paths = sorted((folder / "images").glob("*.png"))
    photos = [Photo(path.name, path, None, Lens(100, 80, 90.0, 96.0, 50.0, 40.0)) for path in paths]
    config = PreparationConfig(clip=clip, dense="none", workers=workers, engine=engine)
    store = FeatureStore(folder / "store")
    reader = preparation.prepare(photos, None, config, [0.4, 0.8], store, "cpu")
    assert len(reader.names) == len(photos)
    return [store.read("clip", photo.name)["features"].clone() for photo in photos]
