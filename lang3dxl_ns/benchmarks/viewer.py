"""`lang3dxl benchmark viewer`: frames per second in a browser, seconds to the first and the sharp picture."""

from __future__ import annotations

import io
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import command_line, describe_machine, markdown_table, write_report
from lang3dxl_ns.query.find_run import find_config

SWITCHES = [
    *("--headless", "--no-sandbox", "--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
]
"""WebGL in software, as on a machine without a GPU."""
_COUNT = """() => {
  window.drawn = 0;
  const next = () => { window.drawn++; requestAnimationFrame(next); };
  next();
}"""
_PATIENCE = 300.0
_ALIKE = 0.5
"""Mean difference, of 255, up to which pictures count as the same."""


@dataclass(kw_only=True)
class ViewerBenchmark:
    """Drag `lang3dxl view` and `ns-viewer` of a run, and a page with many Gaussians, in Chromium."""

    run: tyro.conf.Positional[Path | None] = None
    """Folder of a run, or its config.yml (default: the newest under outputs/)."""
    out: Path
    """Folder for viewer.md and viewer.json."""
    many: int = 300_000
    """Gaussians of the last page: copies of the run's, side by side."""
    seconds: float = 5.0
    """Seconds of dragging."""
    window: tuple[int, int] = (1100, 700)
    """Width and height of the page."""

    def main(self) -> None:
        rows = []
        config = find_config(self.run)
        view = ["lang3dxl", "view", str(config), "--port"]
        server = ["ns-viewer", "--load-config", str(config), "--viewer.websocket-host", "127.0.0.1"]
        pages: dict[str, Callable[[int], Any]] = {
            "lang3dxl view": lambda port: _served([*view, str(port)]),
            "ns-viewer": lambda port: _served([*server, "--viewer.websocket-port", str(port)]),
            f"lang3dxl view, {self.many:,} Gaussians": lambda port: _many(config, self.many, port),
        }
        for name, served in pages.items():
            port = _free_port()
            with served(port):
                rows.append(
                    {"viewer": name, **measure(f"http://127.0.0.1:{port}", self, name == "ns-viewer")}
                )
            print(rows[-1], flush=True)
        data = {"command": command_line("lang3dxl benchmark viewer", self), "machine": describe_machine()}
        write_report(self.out, "viewer", _markdown(data, rows), data | {"rows": rows})


def measure(address: str, settings: ViewerBenchmark, from_server: bool) -> dict[str, float]:
    """Figures of the page at an address. from_server: its pictures are rendered by the server."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise UserError("the benchmark opens pages with playwright: pip install playwright") from error
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise UserError("there is no Chromium: apt install chromium")
    width, height = settings.window
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=chromium, args=SWITCHES)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(_PATIENCE * 1000)
        pictures = _count_pictures(page)
        start = time.monotonic()
        page.goto(address)
        page.locator("canvas").first.wait_for()
        first, sharp = _first_and_sharp(page, start)
        page.evaluate(_COUNT)
        sent, drawn, start = pictures["count"], page.evaluate("window.drawn"), time.monotonic()
        _drag(page, settings)
        spent = time.monotonic() - start
        drawn, sent = page.evaluate("window.drawn") - drawn, pictures["count"] - sent
        found = {
            "first_s": first,
            "sharp_s": sharp,
            # If the server sends pictures, count these; otherwise the page draws its own.
            "fps": (sent if sent > 2 else drawn) / spent,
            "heap_mb": page.evaluate("performance.memory.usedJSHeapSize") / 1e6,
            "received_mb": pictures["bytes"] / 1e6,
        }
        browser.close()
    return found


def _count_pictures(page: Any) -> dict[str, float]:
    """Counts the server's messages that are large enough for a picture, and all its bytes."""
    found: dict[str, float] = {"count": 0, "bytes": 0}

    def received(content: Any) -> None:
        found["bytes"] += len(content)
        found["count"] += len(content) > 2_000

    page.on("websocket", lambda socket: socket.on("framereceived", received))
    return found


def _first_and_sharp(page: Any, start: float) -> tuple[float, float]:
    """Seconds until the page shows something, and until it shows its final picture."""
    seen: list[tuple[float, np.ndarray]] = []
    while time.monotonic() - start < _PATIENCE:
        now = _picture(page)
        seen.append((time.monotonic() - start, now))
        still = len(seen) > 4 and all(np.abs(now - p).mean() < _ALIKE for _, p in seen[-4:])
        if still and now.std() > 5:
            break
    last = seen[-1][1]
    first = next(t for t, picture in seen if picture.std() > 5)
    return first, next(t for t, picture in seen if np.abs(picture - last).mean() < _ALIKE)


def _picture(page: Any) -> np.ndarray:
    """[h, w, 3] pixels of the scene, beside the panel."""
    size = page.viewport_size
    shot = page.screenshot(clip={"x": 0, "y": 0, "width": size["width"] - 350, "height": size["height"]})
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def _drag(page: Any, settings: ViewerBenchmark) -> None:
    x, y = settings.window[0] / 3, settings.window[1] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    end, step = time.monotonic() + settings.seconds, 0
    while time.monotonic() < end:
        step += 1
        page.mouse.move(x + 150 * np.sin(step / 10), y + 20 * np.cos(step / 10))
        page.wait_for_timeout(16)
    page.mouse.up()


# ── servers ─────────────────────────────────────────────────────────────────────────────────────────────


@contextmanager
def _served(command: list[str]) -> Iterator[None]:
    """A viewer's command, once it is serving."""
    command = [str(Path(sys.executable).parent / command[0]), *command[1:]]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        said = []
        for line in process.stdout:
            said.append(line)
            if "Only this machine can open" in line:
                break
        else:
            raise UserError(f"{command[0]} has ended: {''.join(said[-5:])}")
        yield
    finally:
        process.terminate()
        process.wait()


@contextmanager
def _many(config: Path, count: int, port: int) -> Iterator[None]:
    """A page with copies of a run's Gaussians."""
    import torch
    import viser

    from lang3dxl_ns.plugin.light import in_light
    from lang3dxl_ns.plugin.open_run import open_run
    from lang3dxl_ns.plugin.viewer.guard import guard_viewers
    from lang3dxl_ns.plugin.viewer.splats import sent, splats

    guard_viewers()
    _, pipeline, _ = open_run(config)
    gaussians, colors = in_light(pipeline.model, pipeline.scene_file.photos[0].camera, None)
    one = splats(gaussians, colors, 10.0)
    chosen = torch.randint(len(one.centers), (count,), generator=torch.Generator().manual_seed(0)).numpy()
    offset = np.random.default_rng(0).normal(0, 0.05, (count, 3)).astype(np.float32)
    parts = {name: value[chosen] for name, value in vars(one).items()}
    server = viser.ViserServer(host="127.0.0.1", port=port)
    sent(server.scene, "/gaussians", replace(one, **parts | {"centers": parts["centers"] + offset}))
    try:
        yield
    finally:
        server.stop()


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def _markdown(data: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    header = [
        "viewer",
        "first picture, s",
        "sharp picture, s",
        "frames/s while dragging",
        "JS heap, MB",
        "received, MB",
    ]
    lines = [[row["viewer"], *(f"{row[k]:.1f}" for k in list(row)[1:])] for row in rows]
    return f"# Viewers\n\n    {data['command']}\n\n{data['machine']}\n\n{markdown_table(header, lines)}\n"
