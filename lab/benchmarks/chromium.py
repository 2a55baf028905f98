"""Chromium for benchmarks of the page, which draws by software, and a server that counts what it sends."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from lang3dxl_ns.common.errors import UserError

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_SWITCHES = (
    *("--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--enable-precise-memory-info"),
)


@contextmanager
def chromium() -> Iterator[Any]:
    """Start Chromium; yields playwright's browser. Raises UserError without either of them."""
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError as error:
        raise UserError("playwright drives the browser: pip install -e '.[test]'") from error
    program = next(filter(None, map(shutil.which, _NAMES)), None)
    if program is None:
        raise UserError("there is no Chromium on this machine: apt install chromium")
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=program, args=_SWITCHES)
        try:
            yield browser
        finally:
            browser.close()


class Counting(SimpleHTTPRequestHandler):
    """Handler that counts the bytes that it sends, and logs nothing."""

    sent = 0

    def copyfile(self, source: Any, outputfile: Any) -> None:
        content = source.read()
        type(self).sent += len(content)
        outputfile.write(content)

    def log_message(self, *_: object) -> None:
        """Log nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder; yields its address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Counting, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
