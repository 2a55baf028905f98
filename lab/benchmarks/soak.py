"""A soak: browsers come to a viewer and go, and its memory is watched. Run by hand:

PYTHONPATH=tests python -m lab.benchmarks.soak --clients 200 --minutes 10
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import sys
import tempfile
import threading
import time
from pathlib import Path

import msgspec
import numpy as np


def client(port: int, seed: int, seconds: float) -> None:
    """A browser that looks around for a while and leaves, politely or not."""
    from websockets.sync.client import connect
    from websockets.typing import Origin

    rng = np.random.default_rng(seed)
    socket = connect(f"ws://127.0.0.1:{port}", origin=Origin(f"http://127.0.0.1:{port}"), max_size=None)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        position = rng.normal(0, 1, 3) * 5 + [0, -30, 5]
        camera = {
            "type": "ViewerCameraMessage",
            "wxyz": [0.7071, -0.7071, 0.0, 0.0],
            "position": position.tolist(),
            "fov": 1.0,
            "aspect": float(rng.uniform(0.5, 2)),
            "look_at": [0.0, 0.0, 0.0],
            "up_direction": [0.0, 0.0, 1.0],
        }
        socket.send(msgspec.msgpack.encode(camera))
        pause = time.monotonic() + 0.3
        while (left := pause - time.monotonic()) > 0:
            try:
                socket.recv(timeout=left)
            except TimeoutError:
                break
    if seed % 3:
        socket.close()
    else:  # as a laptop that is closed
        socket.socket.close()


def resident() -> float:
    """Megabytes of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def soak(port: int, clients: int, seconds: float, at_once: int = 4) -> list[tuple[float, float]]:
    """Seconds and megabytes, measured as `clients` come one after another, `at_once` at a time."""
    start, stay = time.monotonic(), seconds / clients * at_once
    spawn = multiprocessing.get_context("spawn")
    history: list[tuple[float, float]] = []
    with spawn.Pool(at_once) as pool:
        waiting = [pool.apply_async(client, (port, seed, stay)) for seed in range(clients)]
        for done in waiting:
            done.get()
            history.append((time.monotonic() - start, resident()))
    return history


def serve(folder: Path):
    """A viewer of a small run, as ns-viewer starts it."""
    from conftest import make_trainer
    from nerfstudio.configs.base_config import ViewerConfig
    from nerfstudio.utils import writer
    from nerfstudio.viewer.viewer import Viewer
    from scenes import write_scene
    from tiny_models import make_tiny_clip, make_tiny_dinov2

    from lang3dxl_ns.plugin.trainer_config import open_run

    data = write_scene(folder / "scene", photos=6, points=2000)
    clip, dense = make_tiny_clip(folder / "clip"), make_tiny_dinov2(folder / "dinov2")
    trainer = make_trainer(data, clip, dense, folder / "outputs", 20)
    trainer.setup()
    trainer.train()
    config, pipeline, step = open_run(trainer.base_dir / "config.yml")
    del trainer
    viewer = Viewer(
        ViewerConfig(websocket_host="127.0.0.1", num_rays_per_chunk=1 << 15),
        log_filename=config.get_base_dir() / "viewer.log",
        datapath=pipeline.datamanager.get_datapath(),
        pipeline=pipeline,
        train_lock=threading.Lock(),
    )
    config.logging.local_writer.enable = False
    writer.setup_local_writer(config.logging, max_iter=1, banner_messages=None)
    viewer.init_scene(pipeline.datamanager.train_dataset, "completed", pipeline.datamanager.eval_dataset)
    viewer.update_scene(step=step)
    return viewer


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--clients", type=int, default=200)
    arguments.add_argument("--minutes", type=float, default=10.0)
    chosen = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        viewer = serve(Path(folder))
        history = soak(viewer.viser_server.get_port(), chosen.clients, 60 * chosen.minutes)
    gc.collect()
    first = next((mb for seconds, mb in history if seconds >= min(60, 6 * chosen.minutes)), history[0][1])
    for seconds, mb in history[:: max(len(history) // 20, 1)]:
        print(f"{seconds:6.0f} s  {mb:7.1f} MB")
    server = viewer.viser_server._websock_server
    print(
        f"{len(history)} clients in {history[-1][0]:.0f} s: {first:.1f} MB after the first minute, "
        f"{resident():.1f} MB at the end; {threading.active_count()} threads, "
        f"{len(server._client_state_from_id)} connections, {len(viewer.render_statemachines)} renderers"
    )


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    os._exit(0)  # threads that render would see the interpreter end under them
