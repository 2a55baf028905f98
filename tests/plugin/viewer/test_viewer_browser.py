"""The viewer in a browser, from the open page to a flight."""

import io
import re
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import make_trainer
from PIL import Image
from scenes import write_scene

pytestmark = pytest.mark.slow
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SWITCHES = [
    *("--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
]
VISERS_OWN = (
    "computeBoundingSphere",  # line geometry of empty frames
    "ERR_NAME_NOT_RESOLVED",  # a visit counter, on machines without Internet
    "ERR_INTERNET_DISCONNECTED",
    "ERR_CONNECTION",
    "ERR_TIMED_OUT",
)
"""Errors that viser's own page logs."""
FEW_FRAMES = """
const draw = window.requestAnimationFrame;
window.requestAnimationFrame = (frame) => setTimeout(() => draw(frame), 200);
"""
"""The page draws all the time, on the CPU: five times a second is enough."""


@pytest.fixture(scope="module")
def run(tmp_path_factory, tiny_clip, tiny_dense) -> Path:
    """A small run whose photos are gone."""
    root = tmp_path_factory.mktemp("run")
    data = write_scene(root / "scene", photos=6, points=300)
    no_sky = {"pipeline__model__sky_gaussians": 0}  # it fills the view, and the browser draws on the CPU
    trainer = make_trainer(data, tiny_clip, tiny_dense, root / "outputs", iterations=30, **no_sky)
    trainer.setup()
    trainer.train()
    (data / "images").rename(data / "renamed")
    return trainer.base_dir


COMMANDS = {
    "ns-viewer": ("--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port"),
    "lang3dxl view": ("--port",),
}


@pytest.fixture(scope="module", params=COMMANDS)
def address(run, request):
    """Of the viewer that a command serves."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program, *words = request.param.split()
    option = [] if program == "lang3dxl" else ["--load-config"]
    command = [Path(sys.executable).parent / program, *words, *option, run / "config.yml"]
    options = [*COMMANDS[request.param], str(port)]
    log = run / "viewer.log"
    with (
        log.open("w") as output,
        subprocess.Popen([*command, *options], stdout=output, stderr=subprocess.STDOUT) as server,
    ):
        try:
            for _ in range(1800):
                assert server.poll() is None, log.read_text()[-3000:]
                if "Only this machine can open" in log.read_text():
                    break
                time.sleep(0.5)
            yield f"http://127.0.0.1:{port}"
        finally:
            server.terminate()
    assert "Traceback" not in log.read_text(), log.read_text()[-5000:]


@pytest.fixture(scope="module")
def page(address):
    """The open page; checks at the end that it logged no error."""
    playwright = pytest.importorskip("playwright.sync_api", reason="install the [test] extra for playwright")
    if CHROMIUM is None:
        pytest.skip("there is no chromium: apt install chromium")
    errors = []
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        page = browser.new_page(viewport={"width": 800, "height": 420})  # small: the CPU draws it
        page.add_init_script(FEW_FRAMES)
        page.set_default_timeout(240_000)
        page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(address)
        page.get_by_text("Ask the scene").wait_for()
        yield page
        browser.close()
    assert [error for error in errors if not any(known in error for known in VISERS_OWN)] == []


def picture(page) -> np.ndarray:
    """[h, w, 3] pixels of the view, without the panel: always as many, also while the page is laid out."""
    corner = page.locator("canvas").first.bounding_box()
    shot = page.screenshot(
        clip={"x": round(corner["x"]), "y": round(corner["y"]), "width": 450, "height": 340}
    )
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def settled(page, unlike: np.ndarray | None = None, hotter: float = -1.0, seconds: float = 240) -> np.ndarray:
    """The view once it shows something, is stable, differs from another, and has more heat than this."""
    last = picture(page)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.5)
        now = picture(page)
        differs = unlike is None or (np.abs(now - unlike).max(2) > 40).mean() > 0.02
        if differs and heat(now) > hotter and now.std() > 5 and np.abs(now - last).mean() < 0.5:
            return now
        last = now
    raise AssertionError("the view doesn't settle, hasn't changed, or shows no heat")


def heat(pixels: np.ndarray) -> float:
    """Share of pixels as saturated as the heat map's colors."""
    return float((np.ptp(pixels, axis=2) > 100).mean())


def box(page, label: str):
    """The input beside a label."""
    return page.locator(f"label:has-text('{label}')").locator(
        "xpath=following::input[not(@type='hidden')][1]"
    )


def test_from_a_typed_word_to_where_it_is(page):
    plain = settled(page)
    # CLIP has random weights here: a threshold of 0 guarantees a match.
    threshold = box(page, "Threshold")
    threshold.fill("0")
    threshold.press("Enter")
    box(page, "Look for").fill("dome; door")
    with_heat = settled(page, unlike=plain, hotter=heat(plain) + 0.05)
    fly = page.get_by_role("button", name="dome")
    fly.wait_for()
    fly.click()
    page.get_by_text(re.compile(r"^1 of \d+:")).wait_for()
    there = settled(page, unlike=with_heat)
    page.get_by_role("button", name="Next").click()
    page.get_by_text(re.compile(r"^2 of \d+:")).wait_for()
    settled(page, unlike=there)


def test_odd_texts_get_an_answer_in_the_panel(page):
    for text, says in (
        ("окно 🙂", "окно"),
        ("<script>{dome}_*a*", "<script>{dome}_*a*"),
        ("long " * 400, "beginning of a long text"),
        ('not "dome"', "only negatives"),
        ("", "Type what to look for"),
    ):
        box(page, "Look for").fill(text)
        page.get_by_text(says).first.wait_for()


def test_the_command_says_how_to_let_others_in(page):
    page.get_by_text("Who can open this page").click()
    page.get_by_text("--viewer.websocket-host 0.0.0.0").wait_for()
