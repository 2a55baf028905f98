"""`lang3dxl benchmark page`: how fast the page of a scene answers in Chromium, which draws by software."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from lab.reports import command_line
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import markdown_table, write_report
from lang3dxl_ns.common.settings_help import showing

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_SWITCHES = (
    *("--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--enable-precise-memory-info"),
)
GOALS = {
    "a word's heat": 0.15,
    "its list of things, from then": 0.5,
    "a dragged threshold": 0.1,
    "a word taught by a click": 1.0,
}
"""Most seconds at 10,000 Gaussians, until colors are given to the drawing, which takes as long as a machine's
graphics do. Lists wait for that drawing."""
WORDS = ("windows", "doors", "towers", "spires", "domes", "roof", "wall", "arch", "column", "statue")
_TIMES = """async ([words, repeats]) => {
  const { view, prompts } = lang3dxl, times = { heat: [], things: [], drag: [], teach: [] };
  const wait = async (done) => { while (!done()) await new Promise((go) => setTimeout(go)); };
  const timed = async (kind, work) => {
    const start = performance.now();
    await work();
    times[kind].push((performance.now() - start) / 1000);
  };
  const { clientWidth: x, clientHeight: y } = view.frame;
  for (let k = 0; k < repeats; k++) {
    lang3dxl.clear();
    await new Promise((go) => setTimeout(go, 300));
    await timed("heat", () => lang3dxl.ask(words[k % words.length]));
    await timed("things", () => wait(() => prompts.at(-1)?.found));
    const slider = document.querySelector("#prompts input[type=range]");
    if (!slider) throw new Error(`the page doesn't know ${words[k % words.length]}`);
    slider.value = 0.2 + (0.6 * k) / repeats;
    await timed("drag", () => slider.dispatchEvent(new Event("input", { bubbles: true })));
    const at = { x: x * (0.4 + (0.2 * k) / repeats), y: y * 0.6 };
    view.dispatchEvent(new CustomEvent("click", { detail: at }));
    const like = () => [...document.querySelectorAll("#here button")].find((one) => one.textContent === "Like this");
    await wait(() => like() || /^Nothing/.test(document.getElementById("here").textContent));
    if (like()) await timed("teach", () => (like().click(), wait(() => prompts.at(-1)?.examples?.length && prompts.at(-1).relevancy)));
    document.getElementById("here").replaceChildren();
  }
  return times;
}"""  # noqa: E501


@showing("scene", "out")
@dataclass
class PageBenchmark:
    """Time words, lists of things, dragged thresholds and taught words in the page of a scene."""

    scene: Path
    """Scene file or run, as `lang3dxl query` takes it."""
    out: Path
    """Folder for page.md."""
    repeats: int = 15
    """Number of times that each is measured."""

    def main(self) -> None:
        from lang3dxl_ns.open_scene import load_scene
        from lang3dxl_ns.web.write_page import Page, write_page

        scene = load_scene(self.scene)
        with TemporaryDirectory() as folder:
            write_page(Page(scene), Path(folder))
            times = self.measured(Path(folder))
        rows = [
            [what, f"{median(seconds):.3f}", f"{max(seconds):.3f}", f"{goal:g}"]
            for (what, goal), seconds in zip(GOALS.items(), times.values(), strict=True)
        ]
        table = markdown_table(["seconds until", "median", "slowest", "goal at 10,000 Gaussians"], rows)
        command = command_line("lang3dxl benchmark page", self)
        text = f"# The page's speed\n\n    {command}\n\n{len(scene.splats):,} Gaussians.\n\n{table}\n"
        write_report(self.out, "page", text, {"gaussians": len(scene.splats), **times})
        print(text)

    def measured(self, folder: Path) -> dict[str, list[float]]:
        """Open a page in Chromium and measure it."""
        with chromium() as browser, served(folder) as address:
            page = browser.new_page(viewport={"width": 720, "height": 450}, reduced_motion="reduce")
            page.set_default_timeout(300_000)
            page.goto(address)
            page.evaluate("lang3dxl.ready.then(() => true)")
            page.evaluate(_TIMES, [WORDS, 2])  # compiles
            times: dict[str, list[float]] = page.evaluate(_TIMES, [WORDS, self.repeats])
        return times


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


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Log nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder; yields its address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
